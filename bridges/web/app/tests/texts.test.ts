import assert from "node:assert/strict";
import { readFileSync, readdirSync } from "node:fs";
import test from "node:test";
import { transformSync } from "esbuild";
import { texts } from "../src/texts";

/** What people don't read, or is the same in all languages. */
const NO_TEXT = /^(function |aira |Withdrawal\(|color-mix\(|\d+px |xMid)|^(AIRA|[KMGT]iB|AbortError|Content-(Type|Length)|X-Aira-Request|Permit)$/;

/** The texts in a source: a word with a capital, or two words that are no classes. */
function textsIn(source: string): string[] {
  // As JavaScript without comments, in which the texts between tags are strings, too.
  const { code } = transformSync(source, { loader: "tsx", jsx: "transform", jsxFactory: "h", jsxFragment: "f", legalComments: "none", charset: "utf8" });
  const literals = code.matchAll(/(class: (?:[^"`,\n]|"[^"]*"|`[^`]*`)*)|"((?:[^"\\\n]|\\.)*)"|`((?:[^`\\]|\\.)*)`/g);
  return [...literals]
    .map(([, , string, template]) => string ?? (template ?? "").replace(/\$\{(?:[^{}]|\{[^{}]*\})*\}/g, "0"))
    .filter((text) => /^[A-Z][a-z]+|[a-z]{2} [a-z]{2}|[a-z]{2}[.!?]$/.test(text) && !NO_TEXT.test(text));
}

test("texts are found wherever they stand", () => {
  assert.deepEqual(textsIn('const a = <p class="row between">Stop the robot</p>;'), ["Stop the robot"]);
  assert.deepEqual(textsIn('const a = <p title="Stop">{ready ? "Done" : `${count} of them are left`}</p>;'), ["Stop", "Done", "0 of them are left"]);
  assert.deepEqual(textsIn("const a = <p class={`row ${wide ? 1 : 2}`}>{texts.stop}</p>; // Stop the robot"), []);
});

test("all that people read stands in texts.ts", () => {
  const files = (readdirSync("src", { recursive: true }) as string[]).filter((name) => /\.tsx?$/.test(name) && name !== "texts.ts");
  assert.ok(files.length > 20);
  const found = files.flatMap((name) => textsIn(readFileSync(`src/${name}`, "utf8")).map((text) => `${name}: ${text}`));
  assert.deepEqual(found, []);
});

test("each text is used", () => {
  const used = (readdirSync("src", { recursive: true }) as string[]).filter((name) => /\.tsx?$/.test(name)).map((name) => readFileSync(`src/${name}`, "utf8")).join("");
  assert.deepEqual(Object.keys(texts).filter((name) => !new RegExp(`texts\\.${name}\\b`).test(used)), []);
});
