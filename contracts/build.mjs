// Compiles the contracts and writes one JSON artifact each; with --check it writes nothing and fails where one differs,
// and with --input it only prints what the compiler is given of the suite.
import { existsSync, mkdirSync, readFileSync, readdirSync, writeFileSync } from "node:fs";
import { dirname, join } from "node:path";
import { fileURLToPath } from "node:url";
import solc from "solc";

const here = dirname(fileURLToPath(import.meta.url));

// Where each contract's artifact goes: the suite into the package, what only tests need beside the tests.
const suite = join(here, "..", "mesh", "chain", "artifacts");
const tests = join(here, "..", "tests", "contracts", "artifacts");
const wanted = {
  "src/ENSRegistry.sol": { ENSRegistry: suite },
  "src/Resolver.sol": { Resolver: suite },
  "src/XRT.sol": { XRT: suite },
  "src/Factory.sol": { Factory: suite },
  "src/Lighthouse.sol": { Lighthouse: suite },
  "src/Liability.sol": { Liability: suite },
  "src/Jury.sol": { Jury: suite },
  "src/Multicall.sol": { Multicall: suite },
  "fixtures/Tokens.sol": {
    FeeToken: tests,
    SilentToken: tests,
    RefusingToken: tests,
    HookedToken: tests,
    BlockingToken: tests,
    HeavyToken: tests,
    StrictToken: tests,
    PhantomToken: tests,
    LyingToken: tests,
    CallingToken: tests,
    DollarToken: tests,
    VersionedToken: tests,
  },
  "fixtures/Crowd.sol": { Crowd: tests },
  "fixtures/Validators.sol": { OneSigner: tests, BrokenValidator: tests },
};

const settings = {
  evmVersion: "cancun",
  viaIR: true,
  optimizer: { enabled: true, runs: 1_000_000 },
  // Nothing in the bytecode that depends on comments or on where the sources lie.
  metadata: { appendCBOR: false, bytecodeHash: "none" },
};
const deployed = ["evm.deployedBytecode.object", "evm.deployedBytecode.immutableReferences"];
const outputSelection = { "*": { "*": ["abi", "evm.bytecode.object", ...deployed] } };

function input(folders, settings) {
  const sources = {};
  for (const folder of folders) {
    for (const name of readdirSync(join(here, folder)).sort()) {
      sources[`${folder}/${name}`] = { content: readFileSync(join(here, folder, name), "utf8") };
    }
  }
  return JSON.stringify({ language: "Solidity", settings, sources });
}

function compile() {
  const output = JSON.parse(solc.compile(input(["src", "fixtures"], { ...settings, outputSelection })));
  const complaints = output.errors ?? [];
  for (const complaint of complaints) console.error(complaint.formattedMessage);
  if (complaints.length > 0) process.exit(1);
  return output.contracts;
}

function artifact(contractName, contract) {
  const compiler = { name: "solc", version: solc.version(), ...settings };
  return `${JSON.stringify(
    {
      contractName,
      abi: contract.abi,
      bytecode: `0x${contract.evm.bytecode.object}`,
      deployedBytecode: `0x${contract.evm.deployedBytecode.object}`,
      // Where the constructor writes each immutable: one list of offsets each, in bytes of the deployed code.
      immutables: Object.values(contract.evm.deployedBytecode.immutableReferences ?? {}).map((places) =>
        places.map((place) => place.start),
      ),
      compiler,
    },
    null,
    1,
  )}\n`;
}

if (process.argv.includes("--input")) {
  console.log(input(["src"], settings));
  process.exit(0);
}
const checking = process.argv.includes("--check");
const contracts = compile();
let stale = 0;
for (const [file, names] of Object.entries(wanted)) {
  for (const [name, folder] of Object.entries(names)) {
    const path = join(folder, `${name}.json`);
    const text = artifact(name, contracts[file][name]);
    if (existsSync(path) && readFileSync(path, "utf8") === text) continue;
    if (checking) {
      console.error(`${path} is not what the sources give: run "make contracts"`);
      stale += 1;
    } else {
      mkdirSync(folder, { recursive: true });
      writeFileSync(path, text);
      console.log(`wrote ${path}`);
    }
  }
}
process.exit(stale > 0 ? 1 : 0);
