// Calls of the contracts: what a wallet sends, and what the page reads to check the server.

import { decodeFunctionResult, encodeFunctionData, hexToBytes, parseAbi, slice } from "viem";
import type { Address, Hex } from "viem";
import { encodeBase58 } from "./cid";

const ABI = parseAbi([
  "function approve(address spender, uint256 value) returns (bool)",
  "function permit(address owner, address spender, uint256 value, uint256 deadline, uint8 v, bytes32 r, bytes32 s)",
  "function nonces(address owner) view returns (uint256)",
  "function DOMAIN_SEPARATOR() view returns (bytes32)",
  "function name() view returns (string)",
  "function version() view returns (string)",
  "function refill(uint256 value)",
  "function withdraw(uint256 value)",
  "function createLighthouse(uint256 minimalStake, uint256 timeoutInBlocks, string name) returns (address)",
  "function refund(address liability)",
  "function model() view returns (bytes)",
  "function objective() view returns (bytes)",
  "function result() view returns (bytes)",
  "function promisee() view returns (address)",
  "function promisor() view returns (address)",
  "function token() view returns (address)",
  "function cost() view returns (uint256)",
  "function demandHash() view returns (bytes32)",
  "function isFinalized() view returns (bool)",
  "function isSuccess() view returns (bool)",
  "function isLiability(address account) view returns (bool)",
  "function isValidator(address signer) view returns (bool)",
  "function jurors() view returns (address[])",
  "function quorum() view returns (uint256)",
]);

type Getter =
  | "model" | "objective" | "result" | "promisee" | "promisor" | "token" | "cost" | "demandHash" | "isFinalized" | "isSuccess" | "jurors" | "quorum"
  | "DOMAIN_SEPARATOR" | "name" | "version";

export const calls = {
  approve: (spender: Address, value: bigint) => encodeFunctionData({ abi: ABI, functionName: "approve", args: [spender, value] }),
  permit: (owner: Address, spender: Address, value: bigint, deadline: bigint, signature: Hex) =>
    encodeFunctionData({
      abi: ABI, functionName: "permit",
      args: [owner, spender, value, deadline, Number(slice(signature, 64)), slice(signature, 0, 32), slice(signature, 32, 64)],
    }),
  refill: (value: bigint) => encodeFunctionData({ abi: ABI, functionName: "refill", args: [value] }),
  withdraw: (value: bigint) => encodeFunctionData({ abi: ABI, functionName: "withdraw", args: [value] }),
  refund: (liability: Address) => encodeFunctionData({ abi: ABI, functionName: "refund", args: [liability] }),
  createLighthouse: (stake: bigint, timeout: bigint, name: string) =>
    encodeFunctionData({ abi: ABI, functionName: "createLighthouse", args: [stake, timeout, name] }),
};

/** Reads a contract: through the wallet's own node, or the server's. */
export type Reader = (to: Address, data: Hex) => Promise<Hex>;

export async function read(reader: Reader, liability: Address, functionName: Getter): Promise<any> {
  const data = await reader(liability, encodeFunctionData({ abi: ABI, functionName }));
  return decodeFunctionResult({ abi: ABI, functionName, data });
}

/** The nonce of an account's next permit for a token (EIP-2612). */
export async function nonceOf(reader: Reader, token: Address, owner: Address): Promise<bigint> {
  const data = await reader(token, encodeFunctionData({ abi: ABI, functionName: "nonces", args: [owner] }));
  return decodeFunctionResult({ abi: ABI, functionName: "nonces", data });
}

/** Whether a validator's contract accepts what an account signs. */
export async function acceptsSigner(reader: Reader, validator: Address, signer: Address): Promise<boolean> {
  const data = await reader(validator, encodeFunctionData({ abi: ABI, functionName: "isValidator", args: [signer] }));
  return decodeFunctionResult({ abi: ABI, functionName: "isValidator", data });
}

/** The text of a CID in a contract; empty if there is none. */
export function cidText(bytes: Hex): string {
  return bytes.length > 2 ? encodeBase58(hexToBytes(bytes)) : "";
}
