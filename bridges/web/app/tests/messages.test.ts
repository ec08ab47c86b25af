import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import test from "node:test";
import { privateKeyToAccount } from "viem/accounts";
import { canonicalSignature, encodeWire, orderFields, orderHash, recordHash, resultHash, signerOf, withdrawalHash } from "../src/messages";
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

test("records that a wallet signs have the hashes that Python gives them", () => {
  const address = "0x19437Cb65760805A0e55339186F03B2d980eBBf9";
  const cid = "QmS9JArPwa55ePgDnyg6TzX24mYTS1b1vLqWNebyVotKxQ";
  const terms = { model: cid, objective: cid, token: address, cost: 5n * 10n ** 18n, lighthouse: address, validator: address, deadline: 100n, validatorFee: 1n } as const;
  const accept = (order: Parameters<typeof orderFields>[0]) => recordHash("aira accept", { signature: "", demand: orderFields(order, ""), robot: address, maker: address });
  assert.equal(accept({ ...terms, nonce: 7n, sender: address }), "0x0e0fab30fb002b19863c549487eb2947843e463e3b079d91552f44324f4d7c94");
  assert.equal(accept({ ...terms, nonce: "ab".repeat(32) }), "0x713364bc16340f8a66e6b3e540a2c62c2cd6a0aca2a437ce56bef54978c69e4e");
  const signature = "ab".repeat(65);
  const { validatorFee: _, ...offered } = terms;
  const [demand, offer] = [orderFields({ ...terms, nonce: 7n, sender: address }, signature), orderFields({ ...offered, lighthouseFee: 1n, nonce: 7n, sender: address }, signature)];
  assert.equal(recordHash("aira pair", { demand, offer, maker: address }), "0xa8bbe661ce418952000a16c8bb1be8f2755302cd1ae24a3858294a73e2076f3b");
  const stop = { liability: address, by: address, why: 'so "ä" \u2028 </x>', time: 7 };
  assert.equal(recordHash("aira stop", stop), "0x658a82bb35e1f102c8ad5e31fb2e26a2d2aff76e267df54d42ec8dc7749cb190");
});

test("a signature in another form is refused", async () => {
  const message = read(vectors[0].wire);
  const digits: string = message.signature;
  for (const other of [digits.slice(2), digits.slice(0, 128) + "00", digits.slice(0, 64) + "f".repeat(64) + "1b"]) {
    await assert.rejects(signerOf(vectors[0].hash, other));
  }
});
