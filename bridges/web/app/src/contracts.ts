// Calls of the contracts: what a wallet sends, and what the page reads to check the server.

import { decodeFunctionResult, encodeFunctionData, hexToBytes, parseAbi } from "viem";
import type { Address, Hex } from "viem";
import { encodeBase58 } from "./cid";

const ABI = parseAbi([
  "function approve(address spender, uint256 value) returns (bool)",
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
  | "model" | "objective" | "result" | "promisee" | "promisor" | "token" | "cost" | "demandHash" | "isFinalized" | "isSuccess" | "jurors" | "quorum";

export const calls = {
  approve: (spender: Address, value: bigint) => encodeFunctionData({ abi: ABI, functionName: "approve", args: [spender, value] }),
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

/** Whether a validator's contract accepts what an account signs. */
export async function acceptsSigner(reader: Reader, validator: Address, signer: Address): Promise<boolean> {
  const data = await reader(validator, encodeFunctionData({ abi: ABI, functionName: "isValidator", args: [signer] }));
  return decodeFunctionResult({ abi: ABI, functionName: "isValidator", data });
}

/** The text of a CID in a contract; empty if there is none. */
export function cidText(bytes: Hex): string {
  return bytes.length > 2 ? encodeBase58(hexToBytes(bytes)) : "";
}
