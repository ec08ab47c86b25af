// Wallets that announce themselves by EIP-6963, spoken to by EIP-1193.

import { toHex } from "viem";
import type { Address, Hex } from "viem";
import { plain } from "./format";
import { texts } from "./texts";

export interface Provider {
  request(call: { method: string; params?: unknown[] }): Promise<any>;
  on?(event: string, listener: (value: any) => void): void;
}

export interface Announced {
  info: { uuid: string; name: string; icon: string; rdns: string };
  provider: Provider;
}

const REJECTED = 4001;
const UNKNOWN_CHAIN = 4902;
const POLL = 700;
const LONGEST_WAIT = 180_000;

/** What a wallet answered, in words for people; `rejected` if the person said no. */
export class WalletError extends Error {
  constructor(
    message: string,
    readonly rejected: boolean,
    readonly unknownChain: boolean,
  ) {
    super(message);
  }
}

const wallets = new Map<string, Announced>();
const watchers = new Set<() => void>();

window.addEventListener("eip6963:announceProvider", (event) => {
  const announced = (event as CustomEvent<Announced>).detail;
  if (typeof announced?.info?.uuid !== "string" || typeof announced.provider?.request !== "function") return;
  wallets.set(announced.info.uuid, announced);
  for (const watcher of watchers) watcher();
});
window.dispatchEvent(new Event("eip6963:requestProvider"));

export function announcedWallets(): Announced[] {
  return [...wallets.values()];
}

export function watchWallets(watcher: () => void): () => void {
  watchers.add(watcher);
  return () => watchers.delete(watcher);
}

export async function ask(provider: Provider, method: string, params: unknown[] = []): Promise<any> {
  try {
    return await provider.request({ method, params });
  } catch (error) {
    const { code, message } = error as { code?: number; message?: string };
    const rejected = code === REJECTED;
    throw new WalletError(rejected ? texts.rejectedInWallet : plain(String(message ?? error)), rejected, code === UNKNOWN_CHAIN);
  }
}

/** Signs 32 bytes as a personal message. */
export function personalSign(provider: Provider, hash: Hex, account: Address): Promise<string> {
  return ask(provider, "personal_sign", [hash, account]);
}

/** Signs typed data (EIP-712), which the wallet shows. */
export function signTypedData(provider: Provider, data: string, account: Address): Promise<string> {
  return ask(provider, "eth_signTypedData_v4", [account, data]);
}

export async function switchChain(provider: Provider, chainId: number): Promise<void> {
  try {
    await ask(provider, "wallet_switchEthereumChain", [{ chainId: toHex(chainId) }]);
  } catch (error) {
    if (error instanceof WalletError && error.unknownChain) throw new WalletError(texts.unknownChain(chainId), false, true);
    throw error;
  }
}

/** Sends a transaction and waits until it is in a block. Throws if it was refused or reverted. */
export async function transact(provider: Provider, from: Address, to: Address, data: Hex): Promise<Hex> {
  const hash: Hex = await ask(provider, "eth_sendTransaction", [{ from, to, data }]);
  for (const end = Date.now() + LONGEST_WAIT; Date.now() < end; ) {
    const receipt = await ask(provider, "eth_getTransactionReceipt", [hash]);
    if (receipt && BigInt(receipt.status) === 0n) throw new WalletError(texts.transactionReverted(hash), false, false);
    if (receipt) return hash;
    await new Promise((resolve) => setTimeout(resolve, POLL));
  }
  throw new WalletError(texts.transactionPending(hash), false, false);
}
