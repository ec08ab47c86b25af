// From a draft to a signed and published demand.

import { zeroAddress } from "viem";
import type { Address, Hex } from "viem";
import { ApiError, get, post, postText } from "./api";
import type { Account } from "./app";
import { canonicalSignature, encodeWire, orderHash, randomNonce, signerOf, withdrawalHash } from "./messages";
import type { Demand } from "./messages";
import { texts } from "./texts";
import { ServerLies, checkAsked, checkOrder, ownOrders, rememberOrder } from "./trust";
import type { AccountState, Market, Order, PostedOrder } from "./types";
import { personalSign } from "./wallet";

export interface Draft {
  model: string;
  objective: string;
  cost: bigint;
  validator: Address;
  validatorFee: bigint;
  lifetime: number;
}

/** The demand that a wallet is to sign, with a deadline and a nonce of now. */
export async function prepare(draft: Draft, account: Address): Promise<{ demand: Demand; hash: Hex }> {
  const [market, state] = await Promise.all([get<Market>("market"), get<AccountState>(`accounts/${account}`)]);
  const demand: Demand = {
    model: draft.model,
    objective: draft.objective,
    token: market.token.address,
    cost: draft.cost,
    lighthouse: market.lighthouse.address,
    validator: draft.validator,
    validatorFee: draft.validatorFee,
    deadline: BigInt(market.block + draft.lifetime),
    nonce: state.nonce === null ? randomNonce() : BigInt(state.nonce),
    sender: state.nonce === null ? undefined : account,
  };
  return { demand, hash: orderHash(demand) };
}

/** Signs the hash of exactly these fields, and publishes the demand. Returns its hash. */
export async function signAndPost(demand: Demand, shown: Hex, account: Account): Promise<string> {
  if (account.kind !== "wallet") throw new Error(texts.needsWallet);
  const hash = orderHash(demand);
  if (hash !== shown) throw new ServerLies(texts.lieHash);
  const signature = canonicalSignature(await personalSign(account.wallet.provider, hash, account.address));
  if ((await signerOf(hash, signature)) !== account.address) throw new Error(texts.otherAccountSigned);
  const wire = encodeWire({ ...demand, signature });
  const own = hash.slice(2);
  // Before it is posted: what is signed may become a job, whatever the server answers.
  rememberOrder({ hash: own, deadline: Number(demand.deadline), wire });
  const posted = await postText<PostedOrder>("orders", wire);
  if (posted.order.hash !== own) throw new ServerLies(texts.lieHash);
  return own;
}

/** Lets the server's local account order. Returns the order's hash. */
export async function orderLocally(draft: Draft, account: Address, market: Market): Promise<string> {
  const { model, objective, lifetime } = draft;
  const [cost, validatorFee] = [String(draft.cost), String(draft.validatorFee)];
  const named = draft.validator === zeroAddress ? "" : draft.validator;
  const fields = { model, objective, cost, validator: named, validatorFee, token: "", lifetime };
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
  const signature = canonicalSignature(await personalSign(account.wallet.provider, hash, account.address));
  await postText("orders", encodeWire({ withdraws: order.hash, lighthouse, deadline, signature }));
  rememberOrder({ hash: order.hash, deadline: order.deadline, wire: "" });
}
