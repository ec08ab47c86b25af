// From a draft to a signed and published demand.

import { zeroAddress } from "viem";
import type { Address, Hex } from "viem";
import { ApiError, get, getExact, post, postText, query } from "./api";
import type { Account } from "./app";
import { calls, nonceOf } from "./contracts";
import { canonicalSignature, encodeWire, orderFields, orderHash, randomNonce, recordHash, signerOf, withdrawalHash } from "./messages";
import type { Demand } from "./messages";
import { PermitRefused, PermitUsed, domainOf, nextPermit, permitFields, permitMessage, permitSigner, typedData } from "./permits";
import type { Domain, Permit, SignedPermit } from "./permits";
import { texts } from "./texts";
import { ServerLies, checkAsked, checkOrder, ownOrders, readerFor, rememberContract, rememberOrder } from "./trust";
import { amount, plain } from "./format";
import type { AccountState, Market, Message, Model, Objective, Order, PostedOrder } from "./types";
import { personalSign, signTypedData } from "./wallet";

/** What a person has asked for, as the fields of the page have it. What is signed is made from it, and from nothing else. */
export interface Wish {
  model: Model;
  objective: () => Promise<Objective>;
  /** The robot that is to do it; empty for whoever takes it first. */
  robot: Address | "";
  cost: bigint;
  validator: Address;
  validatorFee: bigint;
  /** How long it waits for a robot; null for as long as orders usually do. */
  minutes: number | null;
  /** Throws if the validator does not judge for this fee any more. */
  confirm?: () => Promise<void>;
}

export interface Draft extends Omit<Wish, "model" | "objective" | "confirm" | "minutes"> {
  model: string;
  objective: string;
  lifetime: number;
}

/** For how many blocks an order is valid that waits so long. */
export function blocksOf(minutes: number | null, market: Market): number {
  if (minutes === null) return market.defaultLifetime;
  return Math.max(2, Math.round((minutes * 60) / Math.max(market.blockTime, 0.1)));
}

/** An order that is ready to be looked at: all that is shown of it and signed. */
export interface Prepared {
  wish: Wish;
  account: Account;
  market: Market;
  objective: Objective;
  messages: Message[];
  draft: Draft;
  /** What a wallet signs, with a deadline and a nonce of now; the server's account has its own. */
  demand?: Demand;
  hash?: Hex;
  /** What the wallet signs besides, if the contracts may not take the cost yet. */
  permit?: Permit;
}

const SHOWN = 50;

/** What orders of this market depend on: an order that was made for other contracts is not signed. */
export function contractsOf(market: Market): string {
  return [market.chainId, market.factory, market.lighthouse.address, market.token.address, market.token.decimals, market.xrt.address].join();
}

type Priced = Pick<Wish, "cost" | "validator" | "validatorFee">;

/** What the contracts take of the market's token for an order: its cost, and its fee if that is in the same token. */
export function priceOf({ cost, validator, validatorFee }: Priced, market: Market): bigint {
  const isFeeInToken = validator === zeroAddress || market.token.address === market.xrt.address; // without a validator it is for a permit
  return isFeeInToken ? cost + validatorFee : cost;
}

/** The same for an order and all others of the account that may still become contracts: an allowance is for all of them. */
export function neededFor(wish: Priced, state: AccountState, market: Market): bigint {
  return priceOf(wish, market) + neededForOthers(state, market);
}

function neededForOthers(state: AccountState, market: Market): bigint {
  const orders = state.orders.map(({ order }) => order).filter((order) => order.kind === "demand" && order.token === market.token.address);
  const fee = (order: Order) => BigInt(order.validatorFee ?? "0");
  return orders.reduce((sum, order) => sum + priceOf({ ...order, cost: BigInt(order.cost), validatorFee: fee(order) }, market), 0n);
}

/** Makes the objective, and the order that names it; with a permit if the token has such (`domain`) and it needs one. */
export async function prepare(wish: Wish, account: Account, shown: Market, domain: Domain | null): Promise<Prepared> {
  const [objective, market, state] = await Promise.all([wish.objective(), get<Market>("market"), get<AccountState>(`accounts/${account.address}`), wish.confirm?.()]);
  if (contractsOf(market) !== contractsOf(shown)) throw new Error(texts.changedLookAgain);
  const isFile = objective.cid !== wish.model.cid && objective.summary.messages > 0;
  const { messages } = isFile ? await getExact<{ messages: Message[] }>(`files/${objective.cid}/messages${query({ limit: SHOWN })}`) : { messages: [] };
  const { robot, cost, validator, validatorFee } = wish;
  const lifetime = blocksOf(wish.minutes, market);
  const draft = { model: wish.model.cid, objective: objective.cid, robot, cost, validator, validatorFee, lifetime };
  const prepared = { wish, account, market: shown, objective, messages, draft };
  if (account.kind === "local") return prepared;
  const isShort = domain !== null && BigInt(state.token.allowance) < neededFor(wish, state, market);
  // A demand has one fee: the validator's if it has one, else that of the provider which brings its permit to the chain.
  if (isShort && validator === zeroAddress) draft.validatorFee = await permitFee(account.address, cost);
  const [price, needed] = [priceOf(draft, market), neededFor(draft, state, market)];
  if (BigInt(state.token.balance) < price) throw new Error(texts.tooLittle(amount(state.token.balance, market.token), amount(price, market.token)));
  const demand: Demand = {
    model: draft.model,
    objective: draft.objective,
    token: market.token.address,
    cost,
    lighthouse: market.lighthouse.address,
    validator,
    validatorFee: draft.validatorFee,
    deadline: BigInt(market.block + lifetime),
    nonce: state.nonce === null ? randomNonce() : BigInt(state.nonce),
    sender: state.nonce === null ? undefined : account.address,
  };
  const permit = isShort ? await nextPermit(domain, account.address, market.factory, needed, readerFor(account, market).reader) : undefined;
  return { ...prepared, demand, hash: orderHash(demand), permit };
}

/** What the providers that are here want at least for bringing an order with a permit to the chain. */
async function permitFee(address: Address, cost: bigint): Promise<bigint> {
  const { fee } = await get<{ fee: string }>(`accounts/${address}/permit-fee${query({ cost: String(cost) })}`);
  return BigInt(fee);
}

/** A robot does not want the order. */
export class RobotDeclined extends Error {
  constructor(
    readonly code: string,
    detail: string,
  ) {
    super(texts.robotDeclined(plain(detail, 200), plain(code, 60)));
  }
}

/** Signs the hash of exactly these fields, and sends the demand if it is still wanted then. Returns its hash. */
export async function signAndPost({ demand, hash: shown, permit, draft: { robot }, account, market }: Prepared, isWanted: () => boolean): Promise<string> {
  if (account.kind !== "wallet" || !demand) throw new Error(texts.needsWallet);
  const hash = orderHash(demand);
  if (hash !== shown) throw new ServerLies(texts.lieHash);
  const offer = robot ? await offerOf(demand, robot, account) : null;
  const permitted = permit && (await signPermit(permit, account, market));
  if (!isWanted()) throw new Error(texts.changedLookAgain);
  const signature = await signed(hash, account);
  if (!isWanted()) throw new Error(texts.changedLookAgain);
  if ((await signerOf(hash, signature)) !== account.address) throw new Error(texts.otherAccountSigned);
  if (permitted) rememberContract(market);
  const wire = wireOf({ ...demand, signature }, permitted);
  const own = hash.slice(2);
  // Before it is sent: what is signed may become a job, whatever the server answers. One for a robot is never published.
  rememberOrder({ hash: own, deadline: Number(demand.deadline), wire: robot ? "" : wire });
  const posted = robot
    ? await signedRecord("pairs", "aira pair", account, { demand: orderFields(demand, signature), offer, maker: account.address, permit: permitted && permitFields(permitted) })
    : await postText<PostedOrder>("orders", wire);
  if (posted.order.hash !== own) throw new ServerLies(texts.lieHash);
  return own;
}

/** A new permit for the account's open orders, if the contracts may not take what they cost; null if they may. */
export async function permitForOpen(account: Account, market: Market): Promise<Permit | null> {
  const state = await get<AccountState>(`accounts/${account.address}`);
  const needed = neededForOthers(state, market);
  if (BigInt(state.token.allowance) >= needed) return null;
  const { reader } = readerFor(account, market);
  const domain = await domainOf(market.token.address, market.chainId, reader);
  return domain && nextPermit(domain, account.address, market.factory, needed, reader);
}

/** Lets the wallet sign a permit for orders that wait, and sends it. */
export async function signForOpen(permit: Permit, account: Account, market: Market): Promise<void> {
  const signed = await signPermit(permit, account, market);
  await postText("permits", encodeWire(signed));
  rememberContract(market);
  for (const order of ownOrders()) if (order.wire.startsWith("[")) rememberOrder({ ...order, wire: `[${encodeWire(signed)}${order.wire.slice(order.wire.indexOf("},{") + 1)}` });
}

/** Lets the wallet sign a permit. Throws `PermitRefused` if the token does not take it as the account's next one, `PermitUsed` if it has had that. */
async function signPermit(permit: Permit, account: Account, market: Market): Promise<SignedPermit> {
  if (account.kind !== "wallet") throw new Error(texts.needsWallet);
  const { domain, owner, spender, value, nonce, deadline } = permit;
  const { reader } = readerFor(account, market);
  const signature = canonicalSignature(await signTypedData(account.wallet.provider, JSON.stringify(typedData(permit)), owner));
  if ((await permitSigner(permit, `0x${signature}`)) !== owner) throw new Error(texts.otherAccountSigned);
  try {
    await reader(domain.verifyingContract, calls.permit(owner, spender, value, deadline, `0x${signature}`));
  } catch {
    if ((await nonceOf(reader, domain.verifyingContract, owner)) === nonce) throw new PermitRefused(texts.permitRefused);
    throw new PermitUsed(texts.permitUsed);
  }
  return permitMessage(permit, signature);
}

/** What is posted: a signed demand as it travels, after its permit if it has one. */
function wireOf(demand: Record<string, unknown>, permit: SignedPermit | undefined): string {
  return permit ? `[${encodeWire(permit)},${encodeWire(demand)}]` : encodeWire(demand);
}

/** A robot's offer for a demand that is for it alone, of which it gets no signature. */
async function offerOf(demand: Demand, robot: Address, account: Account): Promise<unknown> {
  const wanted = { signature: "", demand: orderFields(demand, ""), robot, maker: account.address };
  const { offer, decline } = await signedRecord<{ offer?: unknown; decline?: { code: string; detail: string } }>("pairs/offers", "aira accept", account, wanted);
  if (offer) return offer;
  throw new RobotDeclined(decline?.code ?? "", decline?.detail ?? "");
}

async function signed(hash: Hex, account: Account): Promise<string> {
  if (account.kind !== "wallet") throw new Error(texts.needsWallet);
  return canonicalSignature(await personalSign(account.wallet.provider, hash, account.address));
}

/** Posts a record with the account's signature. */
async function signedRecord<T = PostedOrder>(path: string, domain: Parameters<typeof recordHash>[0], account: Account, fields: Record<string, unknown>): Promise<T> {
  return postText<T>(path, JSON.stringify({ ...fields, signature: await signed(recordHash(domain, fields), account) }));
}

/** Stops the account's job. */
export async function stopJob(liability: Address, why: string, account: Account): Promise<void> {
  if (account.kind === "local") {
    await post("local/stops", { liability, why });
    return;
  }
  const fields = { liability, by: account.address, why, time: Math.floor(Date.now() / 1000) };
  const signature = await signed(recordHash("aira stop", fields), account);
  await postText("stops", JSON.stringify({ signature, ...fields }));
}

/** Lets the server's local account order. Returns the order's hash. */
export async function orderLocally(draft: Draft, account: Address, market: Market): Promise<string> {
  const { model, objective, lifetime, robot } = draft;
  const [cost, validatorFee] = [String(draft.cost), String(draft.validatorFee)];
  const named = draft.validator === zeroAddress ? "" : draft.validator;
  const fields = { model, objective, cost, validator: named, validatorFee, token: "", lifetime, robot };
  const { order } = await post<PostedOrder>("local/orders", fields);
  checkAsked(order, { model, objective, cost, validator: draft.validator, validatorFee, account, market });
  await checkOrder(order);
  rememberOrder({ hash: order.hash, deadline: order.deadline, wire: "" });
  return order.hash;
}

/** Posts the open orders of this browser that the server does not know: it keeps them in memory only. */
export async function postAgain(block: number): Promise<void> {
  for (const order of ownOrders()) {
    if (!order.wire || order.deadline <= block) continue;
    try {
      await get(`orders/${order.hash}`);
    } catch (error) {
      // Refused: it was used or withdrawn meanwhile, or can't be paid any more.
      if (error instanceof ApiError && error.code !== "unreachable") await postText("orders", order.wire).catch(() => {});
    }
  }
}

export async function withdraw(order: Order, account: Account): Promise<void> {
  if (account.kind === "local") {
    await post("local/withdrawals", { order: order.hash });
    return;
  }
  const { lighthouse } = order;
  const deadline = BigInt(order.deadline);
  const hash = withdrawalHash({ order: `0x${order.hash}`, lighthouse, deadline });
  const signature = await signed(hash, account);
  await postText("orders", encodeWire({ withdraws: order.hash, lighthouse, deadline, signature }));
  rememberOrder({ hash: order.hash, deadline: order.deadline, wire: "" });
}
