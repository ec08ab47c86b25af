// Builds the page into ../static. With --check: whether ../static is what the sources give. With --tests: the tests.

import { build } from "esbuild";
import { mkdir, readFile, readdir, writeFile } from "node:fs/promises";
import { gzipSync } from "node:zlib";

const STATIC = new URL("../static/", import.meta.url);
const MOST = 150 * 1024;
process.chdir(new URL(".", import.meta.url).pathname);

async function outputs() {
  const { outputFiles } = await build({
    entryPoints: { page: "src/main.tsx" },
    bundle: true,
    minify: true,
    write: false,
    outdir: "out",
    format: "esm",
    target: "es2022",
    jsx: "automatic",
    jsxImportSource: "preact",
    legalComments: "none",
    charset: "utf8",
    logLevel: "warning",
  });
  const files = new Map(outputFiles.map((file) => [file.path.split("/").pop(), Buffer.from(file.contents)]));
  for (const name of await readdir("public")) files.set(name, await readFile(`public/${name}`));
  return files;
}

async function tests() {
  const names = (await readdir("tests")).filter((name) => name.endsWith(".test.ts"));
  await build({
    entryPoints: names.map((name) => `tests/${name}`),
    bundle: true,
    platform: "node",
    format: "esm",
    external: ["esbuild"],
    outdir: "node_modules/.tests",
    outExtension: { ".js": ".mjs" },
    jsx: "automatic",
    jsxImportSource: "preact",
    logLevel: "warning",
  });
}

if (process.argv.includes("--tests")) {
  await tests();
} else {
  const files = await outputs();
  const size = [...files.values()].reduce((sum, content) => sum + gzipSync(content, { level: 9 }).length, 0);
  const check = process.argv.includes("--check");
  if (!check) await mkdir(STATIC, { recursive: true });
  for (const [name, content] of files) {
    if (!check) await writeFile(new URL(name, STATIC), content);
    else if (!content.equals(await readFile(new URL(name, STATIC)).catch(() => Buffer.alloc(0)))) {
      console.error(`bridges/web/static/${name} is not what the sources give: run \`make page\``);
      process.exitCode = 1;
    }
  }
  console.log(`${size} bytes gzip of ${MOST}`);
  if (size > MOST) process.exitCode = 1;
}
