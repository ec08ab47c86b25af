import assert from "node:assert/strict";
import test from "node:test";
import { domainSeparator, encodeFunctionResult, parseAbi } from "viem";
import { privateKeyToAccount } from "viem/accounts";
import { recordHash } from "../src/messages";
import { domainOf, permitFields, permitMessage, permitSigner, permitWords, typedData } from "../src/permits";
import { texts } from "../src/texts";
import type { Domain } from "../src/permits";
import type { Hex } from "viem";

const address = "0x19437Cb65760805A0e55339186F03B2d980eBBf9";
const XRT = { address, symbol: "XRT", decimals: 9 } as const;
const account = privateKeyToAccount(`0x${"11".repeat(32)}`);
const permit = {
  domain: { name: "Robonomics", version: "1", chainId: 1337, verifyingContract: address },
  owner: account.address, spender: address, value: 3_500_000_000n, nonce: 3n, deadline: 2_000_000_000n,
} as const;

/** What schemas/messages.py signs with the same key, and writes as services take it. */
const FIELDS = '{"owner":"0x19E7E376E7C213B7E7e7e46cc70A5dD086DAff2A","spender":"0x19437Cb65760805A0e55339186F03B2d980eBBf9","token":"0x19437Cb65760805A0e55339186F03B2d980eBBf9","value":"3500000000","nonce":"3","deadline":"2000000000","domain":"814fcf590cfbe34cda59a27408f1c37b546c1b216cca259b23c816548a2a85f0","signature":"48afd5875c06ebe4824cfdfa24dd160f6bb72a532d335da7a805af561f019c730f4a9df6ce8cbb95e0b39237822d34e75a0b7f0aee64a39aa4e8081dd4b76fc01b"}';
const SIGNATURE = JSON.parse(FIELDS).signature as string;

test("the dialog says how much of which token a permit allows, to whom and until when", () => {
  const words = permitWords(permit, XRT);
  for (const part of ["lets the market's contract take up to 3.5 XRT from your account", "The permit itself costs nothing"]) assert.ok(words.includes(part), words);
  assert.match(words, /until .*2033/);
  assert.match(texts.whatYouSignHow(true, false), /asks twice: for the permit and for the order\. It shows the permit in full/);
  assert.match(texts.whatYouSignHow(false, true), /asks three times: .*offer, for the order and to bind order and offer\. It shows only hashes/);
  assert.match(texts.whatYouSignHow(true, true), /asks four times: /);
});

test("a permit has the hash that Python gives it, and a wallet signs the same", async () => {
  const { types, primaryType, domain, message } = typedData(permit);
  const signature = await account.signTypedData({ types, primaryType, domain, message } as Parameters<typeof account.signTypedData>[0]);
  assert.equal(signature.slice(2), SIGNATURE);
  assert.equal(await permitSigner(permit, signature), account.address);
  assert.notEqual(await permitSigner({ ...permit, value: 1n }, signature), account.address);
  assert.equal(recordHash("aira pair", { demand: {}, permit: permitFields(permitMessage(permit, SIGNATURE)) }), recordHash("aira pair", { demand: {}, permit: JSON.parse(FIELDS) }));
});

test("a permit is signed only for a token whose domain is that of its own name, version, chain and address", async () => {
  const abi = parseAbi(["function name() view returns (string)", "function version() view returns (string)", "function DOMAIN_SEPARATOR() view returns (bytes32)"]);
  const text = (functionName: "name" | "version", result: string) => encodeFunctionResult({ abi, functionName, result });
  const token = ({ name = "Robonomics", version = "1" as string | null, domain = permit.domain as Domain }) => async (_: Hex, data: Hex) => {
    if (data === "0x06fdde03") return text("name", name);
    if (data === "0x54fd4d50" && version !== null) return text("version", version);
    if (data === "0x3644e515") return encodeFunctionResult({ abi, functionName: "DOMAIN_SEPARATOR", result: domainSeparator({ domain }) });
    throw new Error("reverted");
  };
  const domain = { ...permit.domain, name: "USD Coin", version: "2" };
  assert.deepEqual(await domainOf(address, 1337, token({})), permit.domain);
  assert.deepEqual(await domainOf(address, 1337, token({ version: null })), permit.domain);
  assert.deepEqual(await domainOf(address, 1337, token({ name: "USD Coin", version: "2", domain })), domain);
  assert.equal(await domainOf(address, 1337, token({ name: "Other" })), null);
  assert.equal(await domainOf(address, 1337, token({ version: "2" })), null);
  assert.equal(await domainOf(address, 1, token({})), null);
  const other = "0x19E7E376E7C213B7E7e7e46cc70A5dD086DAff2A"; // a token that answers with the domain of one that is worth more
  assert.equal(await domainOf(other, 1337, token({})), null);
  const name = "a".repeat(97);
  assert.equal(await domainOf(address, 1337, token({ name, domain: { ...permit.domain, name } })), null);
  assert.equal(await domainOf(address, 1337, () => Promise.reject(new Error("reverted"))), null);
});
