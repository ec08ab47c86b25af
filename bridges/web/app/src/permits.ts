// Approvals by signature (EIP-2612), with which an account without ether can order.

import { domainSeparator, recoverTypedDataAddress } from "viem";
import type { Address, Hex } from "viem";
import { nonceOf, read } from "./contracts";
import type { Reader } from "./contracts";
import { amount, clock } from "./format";
import { texts } from "./texts";
import type { Token } from "./types";

/** What ties permits to a token (EIP-712). */
export interface Domain {
  name: string;
  version: string;
  chainId: number;
  verifyingContract: Address;
}

/** A permit that is not signed yet: `value` in the token's smallest unit, `deadline` its last second (Unix time). */
export interface Permit {
  domain: Domain;
  owner: Address;
  spender: Address;
  value: bigint;
  nonce: bigint;
  deadline: bigint;
}

/** A token has not taken a permit that is signed as its standard says. */
export class PermitRefused extends Error {}

/** Another order has become a contract with the account's last permit. */
export class PermitUsed extends Error {}

const LIFETIME = 7 * 86_400;
/** Characters of a token's name and version, which the wallet shows. */
const LONGEST_NAME = 96;
const WORDS = ["value", "nonce", "deadline"].map((name) => ({ name, type: "uint256" }));
const TYPES = { Permit: [{ name: "owner", type: "address" }, { name: "spender", type: "address" }, ...WORDS] };
const DOMAIN = [
  { name: "name", type: "string" }, { name: "version", type: "string" },
  { name: "chainId", type: "uint256" }, { name: "verifyingContract", type: "address" },
];

/**
 * The domain of a token's permits, made from its own name, version, chain and address; null if the token has another one:
 * a permit could then be for a token that is worth more.
 */
export async function domainOf(token: Address, chainId: number, reader: Reader): Promise<Domain | null> {
  try {
    const [separator, name, version] = await Promise.all([
      read(reader, token, "DOMAIN_SEPARATOR"), read(reader, token, "name"), read(reader, token, "version").catch(() => "1"),
    ]);
    const domain: Domain = { name, version, chainId, verifyingContract: token };
    if (domain.name.length > LONGEST_NAME || domain.version.length > LONGEST_NAME) return null;
    return domainSeparator({ domain }) === separator ? domain : null;
  } catch {
    return null;
  }
}

/** The account's next permit for a token, valid for a week. */
export async function nextPermit(domain: Domain, owner: Address, spender: Address, value: bigint, reader: Reader): Promise<Permit> {
  const nonce = await nonceOf(reader, domain.verifyingContract, owner);
  return { domain, owner, spender, value, nonce, deadline: BigInt(Math.floor(Date.now() / 1000) + LIFETIME) };
}

/** What a permit means, in words. */
export function permitWords({ value, deadline }: Permit, token: Token): string {
  return texts.permit(amount(value, token), clock(Number(deadline)));
}

/** What a wallet shows and signs of a permit: numbers are decimal texts. */
export function typedData({ domain, owner, spender, value, nonce, deadline }: Permit) {
  const message = { owner, spender, value: String(value), nonce: String(nonce), deadline: String(deadline) };
  return { types: { EIP712Domain: DOMAIN, ...TYPES }, primaryType: "Permit", domain, message };
}

/** Who signed a permit. */
export function permitSigner({ domain, owner, spender, value, nonce, deadline }: Permit, signature: Hex): Promise<Address> {
  return recoverTypedDataAddress({ domain, types: TYPES, primaryType: "Permit", message: { owner, spender, value, nonce, deadline }, signature });
}

/** A signed permit as the market has it. */
export function permitMessage({ domain, owner, spender, value, nonce, deadline }: Permit, signature: string) {
  const token = domain.verifyingContract;
  return { owner, spender, token, value, nonce, deadline, domain: domainSeparator({ domain }).slice(2), signature };
}

export type SignedPermit = ReturnType<typeof permitMessage>;

/** The same as services take it, with the numbers as texts. */
export function permitFields(signed: SignedPermit): Record<string, unknown> {
  return { ...signed, value: String(signed.value), nonce: String(signed.nonce), deadline: String(signed.deadline) };
}
