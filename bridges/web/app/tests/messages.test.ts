import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import test from "node:test";
import { privateKeyToAccount } from "viem/accounts";
import { canonicalSignature, encodeWire, orderHash, resultHash, signerOf, withdrawalHash } from "../src/messages";
import type { Hex } from "viem";

interface Vector {
  kind: string;
  private_key: Hex;
  signer: string;
  hash: Hex;
  wire: string;
}

const folder = "../../../tests/schemas/vectors";
const vectors = [3, 5].flatMap((generation) =>
  JSON.parse(readFileSync(`${folder}/messages-generation-${generation}.json`, "utf8")) as Vector[],
);

/** A message as the page has it: amounts as they are on the wire, whatever their size. */
function read(wire: string): any {
  const fields = JSON.parse(wire.replace(/:(\d+)/g, ':"$1n"'));
  for (const [name, value] of Object.entries(fields)) {
    if (/^\d+n$/.test(String(value))) fields[name] = BigInt(String(value).slice(0, -1));
  }
  return fields;
}

test("messages of the legacy clients have their hashes, signers and wire form", async () => {
  assert.equal(vectors.length, 120);
  for (const { kind, hash, signer, wire, private_key } of vectors) {
    const message = read(wire);
    const own = kind === "result" ? resultHash(message) : orderHash(message);
    assert.equal(own, hash);
    assert.equal(await signerOf(own, message.signature), signer);
    assert.equal(encodeWire(message), wire);
    const signed = await privateKeyToAccount(private_key).signMessage({ message: { raw: own } });
    assert.equal(canonicalSignature(signed), message.signature);
  }
});

test("a changed field changes the hash", () => {
  const message = read(vectors[0].wire);
  for (const name of Object.keys(message)) {
    if (name === "signature") continue;
    const value = message[name];
    const other = typeof value === "bigint" ? value + 1n : vectors.map((one) => read(one.wire)[name]).find((one) => one && one !== value);
    assert.notEqual(orderHash({ ...message, [name]: other }), vectors[0].hash, name);
  }
});

test("a withdrawal has the hash that Python gives it", () => {
  const order = `0x${"ab".repeat(32)}` as Hex;
  const lighthouse = "0x19437Cb65760805A0e55339186F03B2d980eBBf9";
  assert.equal(withdrawalHash({ order, lighthouse, deadline: 44058n }), "0x5a45a464a1cf31ba3688daf919f348cc51b27df59b7e424a32d6f9dca9697100");
});

test("a signature in another form is refused", async () => {
  const message = read(vectors[0].wire);
  const digits: string = message.signature;
  for (const other of [digits.slice(2), digits.slice(0, 128) + "00", digits.slice(0, 64) + "f".repeat(64) + "1b"]) {
    await assert.rejects(signerOf(vectors[0].hash, other));
  }
});
