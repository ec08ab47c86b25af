// The messages of a market: their hashes, signatures and wire form, as in schemas/messages.py and schemas/wire.py.

import { bytesToHex, encodeAbiParameters, encodePacked, keccak256, recoverMessageAddress, toBytes, toHex } from "viem";
import type { Address, Hex } from "viem";
import { parseCid } from "./cid";
import { encodeJson } from "./numbers";
import { texts } from "./texts";

interface Terms {
  model: string;
  objective: string;
  token: Address;
  cost: bigint;
  lighthouse: Address;
  validator: Address;
  deadline: bigint;
  /** 64 hexadecimal digits in generation 3; the factory's counter in generation 5, which has a sender. */
  nonce: string | bigint;
  sender?: Address;
}

export interface Demand extends Terms {
  validatorFee: bigint;
}

export interface Offer extends Terms {
  lighthouseFee: bigint;
}

export interface Result {
  liability: Address;
  result: string;
  success: boolean;
}

export interface Withdrawal {
  order: Hex;
  lighthouse: Address;
  deadline: bigint;
}

const WITHDRAWAL = keccak256(toBytes("Withdrawal(bytes32 order,address lighthouse,uint256 deadline)"));
const HALF_ORDER = 0x7fffffffffffffffffffffffffffffff5d576e7357a4501ddfe92f46681b20a0n;

/** The hash that names an order and that its signature covers. */
export function orderHash(order: Demand | Offer): Hex {
  const isDemand = "validatorFee" in order;
  const [first, second] = isDemand ? [order.lighthouse, order.validator] : [order.validator, order.lighthouse];
  const fee = isDemand ? order.validatorFee : order.lighthouseFee;
  const fields = encodePacked(
    ["bytes", "bytes", "address", "uint256", "address", "address", "uint256", "uint256"],
    [cidHex(order.model), cidHex(order.objective), order.token, order.cost, first, second, fee, order.deadline],
  );
  const tail = order.sender
    ? encodePacked(["uint256", "address"], [BigInt(order.nonce), order.sender])
    : encodePacked(["bytes32"], [`0x${order.nonce}`]);
  return keccak256(`${fields}${tail.slice(2)}`);
}

export function resultHash({ liability, result, success }: Result): Hex {
  return keccak256(encodePacked(["address", "bytes", "bool"], [liability, cidHex(result), success]));
}

export function withdrawalHash({ order, lighthouse, deadline }: Withdrawal): Hex {
  const types = [{ type: "bytes32" }, { type: "bytes32" }, { type: "address" }, { type: "uint256" }] as const;
  return keccak256(encodeAbiParameters(types, [WITHDRAWAL, order, lighthouse, deadline]));
}

/** The hash that a juror signs of its announcement's text. */
export function announcementHash(text: string): Hex {
  return keccak256(toBytes(`aira validator\0${text}`));
}

/** A record that its author signs: the hash covers a prefix of its kind, and its JSON without the signature. */
export function recordHash(domain: "aira accept" | "aira pair" | "aira stop", fields: Record<string, unknown>): Hex {
  return keccak256(toBytes(`${domain}\0${JSON.stringify(fields)}`));
}

/** An order as services take it: amounts as texts, and only the fields that it has. */
export function orderFields(order: Demand | Offer, signature: string): Record<string, unknown> {
  const { model, objective, token, cost, lighthouse, validator, deadline, nonce, sender } = order;
  const fee = "validatorFee" in order ? { validatorFee: String(order.validatorFee) } : { lighthouseFee: String(order.lighthouseFee) };
  const terms = { model, objective, token, cost: String(cost), lighthouse, validator, deadline: String(deadline), ...fee, nonce: String(nonce) };
  return sender === undefined ? { ...terms, signature } : { ...terms, sender, signature };
}

/** Who signed a hash as a personal message. Throws for a signature in any form but the one that the market takes. */
export async function signerOf(hash: Hex, signature: string): Promise<Address> {
  const digits = signature.replace(/^0x/, "");
  const v = digits.slice(128);
  if (!/^[0-9a-f]{130}$/i.test(digits) || !/^1[bc]$/i.test(v) || BigInt(`0x${digits.slice(64, 128)}`) > HALF_ORDER) {
    throw new Error(texts.notASignature);
  }
  return recoverMessageAddress({ message: { raw: hash }, signature: `0x${digits}` });
}

/** A wallet's signature in the market's form: v is 27 or 28, without 0x. */
export function canonicalSignature(signature: string): string {
  const digits = signature.replace(/^0x/, "").toLowerCase();
  const v = parseInt(digits.slice(128), 16);
  return digits.slice(0, 128) + (v < 27 ? v + 27 : v).toString(16);
}

/** A signed message as it travels. Integers are written without quotes, as long as they are. */
export function encodeWire(fields: Record<string, unknown>): string {
  return encodeJson(fields);
}

/** A nonce of generation 3: 32 random bytes whose first is not zero, so that no contract takes it for a sender. */
export function randomNonce(): string {
  const nonce = crypto.getRandomValues(new Uint8Array(32));
  nonce[0] |= 1;
  return toHex(nonce).slice(2);
}

function cidHex(cid: string): Hex {
  return bytesToHex(parseCid(cid));
}
