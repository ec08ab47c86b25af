// What the browser checks itself, so that a server that lies is caught.

import type { Address, Hex } from "viem";
import { getBytes, post } from "./api";
import type { Account } from "./app";
import { cidOf } from "./cid";
import { acceptsSigner, cidText, read } from "./contracts";
import type { Reader } from "./contracts";
import { announcementHash, orderHash, resultHash, signerOf } from "./messages";
import type { Demand, Offer } from "./messages";
import { keep, recall } from "./storage";
import { texts } from "./texts";
import type { Answer, Finding, Job, Market, Order, Validator } from "./types";
import { ask } from "./wallet";

const LARGEST = 64 * 1024 * 1024;
const REMEMBERED = "aira-orders";
const MOST_REMEMBERED = 200;

/** The server said what can't be true. */
export class ServerLies extends Error {}

/** An order as the server writes it, in the form that is hashed. */
export function orderOf(order: Order): Demand | Offer {
  const terms = {
    model: order.model,
    objective: order.objective,
    token: order.token,
    cost: BigInt(order.cost),
    lighthouse: order.lighthouse,
    validator: order.validator,
    deadline: BigInt(order.deadline),
    nonce: order.sender ? BigInt(order.nonce) : order.nonce,
    sender: order.sender ?? undefined,
  };
  if (order.kind === "demand") return { ...terms, validatorFee: BigInt(order.validatorFee ?? "0") };
  return { ...terms, lighthouseFee: BigInt(order.lighthouseFee ?? "0") };
}

/** Throws `ServerLies` unless the order's fields have the hash and the signature that the server gives. */
export async function checkOrder(order: Order): Promise<void> {
  const hash = orderHash(orderOf(order));
  if (hash.slice(2) !== order.hash) throw new ServerLies(texts.lieHash);
  if (order.private) return; // nobody else gets its signature
  const signer = await signerOf(hash, order.signature).catch(() => null);
  if (signer !== order.signer) throw new ServerLies(texts.lieSigner);
}

/** Throws `ServerLies` if an order that the local account made is not the one that was asked for. */
export function checkAsked(
  order: Order,
  asked: { model: string; objective: string; cost: string; validator: Address; validatorFee: string; account: Address; market: Market },
): void {
  const { model, objective, cost, validator, validatorFee, account, market } = asked;
  const same =
    order.kind === "demand" && order.model === model && order.objective === objective && order.cost === cost &&
    order.validator === validator && order.validatorFee === validatorFee && order.signer === account && order.token === market.token.address && order.lighthouse === market.lighthouse.address;
  if (!same) throw new ServerLies(texts.lieAsked);
}

export interface OwnOrder {
  hash: string;
  deadline: number;
  /** The signed message, to post it again; empty if it need not be. */
  wire: string;
}

/** Keeps an order that this browser made, or what changed about it. */
export function rememberOrder(order: OwnOrder): void {
  const known = ownOrders().filter((one) => one.hash !== order.hash);
  keep("localStorage", REMEMBERED, JSON.stringify([order, ...known].slice(0, MOST_REMEMBERED)));
}

/** The orders that this browser made, newest first. */
export function ownOrders(): OwnOrder[] {
  try {
    const known = JSON.parse(recall("localStorage", REMEMBERED) ?? "[]");
    return Array.isArray(known) ? known.filter((one) => typeof one?.hash === "string") : [];
  } catch {
    return [];
  }
}

const contractKey = (market: Market) => `aira-contract-${market.chainId}-${market.generation}`;

/** The market's contract that this browser allowed to take tokens before, on this chain; null if it allowed none. */
export function allowedContract(market: Market): Address | null {
  return recall("localStorage", contractKey(market)) as Address | null;
}

/** Remembers the market's contract as the one that may take tokens. */
export function rememberContract(market: Market): void {
  keep("localStorage", contractKey(market), market.factory);
}

/** Reads contracts through the wallet's node if it is on the same chain: the server can't change those answers. */
export function readerFor(account: Account | null, market: Market): { reader: Reader; independent: boolean } {
  if (account?.kind === "wallet" && account.chainId === market.chainId) {
    const { provider } = account.wallet;
    return { reader: (to, data) => ask(provider, "eth_call", [{ to, data }, "latest"]), independent: true };
  }
  return { reader: throughServer, independent: false };
}

async function throughServer(to: Address, data: Hex): Promise<Hex> {
  const answer = await post<{ result?: Hex; error?: { message: string } }>("../../rpc", {
    jsonrpc: "2.0", id: 1, method: "eth_call", params: [{ to, data }, "latest"],
  });
  if (answer.result === undefined) throw new Error(answer.error?.message ?? texts.unreachable);
  return answer.result;
}

/**
 * Throws `ServerLies` unless jurors whom the validator accepts have signed what the server says of it. Returns whether
 * the wallet's node was asked for that.
 */
export async function checkValidator(said: Validator, account: Account | null, market: Market): Promise<boolean> {
  const { reader, independent } = readerFor(account, market);
  const accepts = await signersOf(said, reader);
  const records = await Promise.all(said.announcements.map((one) => signedAnnouncement(one, said.validator, accepts)));
  const fees = records.map((one) => Number(one.fee)).sort((one, other) => one - other);
  const signed = {
    title: records[0]?.title ?? "",
    online: records.map((one) => one.juror),
    policies: records.flatMap((one) => one.policies).map(policyText),
    fee: fees.length ? fees[Math.min(said.quorum, fees.length) - 1] : null,
  };
  const same =
    said.title === signed.title && said.online.join() === signed.online.join() &&
    said.policies.map(policyText).join() === [...new Set(signed.policies)].join() &&
    (said.announcedFee === null ? null : Number(said.announcedFee)) === signed.fee;
  if (!same) throw new ServerLies(texts.lieValidator);
  return independent;
}

interface Announcement {
  validator: Address;
  juror: Address;
  title: string;
  policies: { name: string; description: string }[];
  fee: number | string;
}

const policyText = (policy: { name: string; description: string }) => JSON.stringify([policy.name, policy.description]);

/** Whether the validator accepts an account's signature. The contract of a jury whose quorum is one says so itself. */
async function signersOf(said: Validator, reader: Reader): Promise<(signer: Address) => Promise<boolean>> {
  if (said.quorum === 1) return async (signer) => signer === said.validator || acceptsSigner(reader, said.validator, signer);
  const [jurors, quorum] = await Promise.all([read(reader, said.validator, "jurors"), read(reader, said.validator, "quorum")]);
  if (Number(quorum) !== said.quorum || jurors.length !== said.jurors) throw new ServerLies(texts.lieValidator);
  return async (signer) => jurors.includes(signer);
}

async function signedAnnouncement(
  one: Validator["announcements"][number],
  validator: Address,
  accepts: (signer: Address) => Promise<boolean>,
): Promise<Announcement> {
  const record: Announcement = JSON.parse(one.text);
  const signer = await signerOf(announcementHash(one.text), one.signature).catch(() => null);
  const isJurors = signer !== null && signer === record.juror && record.validator === validator;
  if (!isJurors || !(await accepts(signer))) throw new ServerLies(texts.lieValidator);
  return record;
}

type Check = (job: Job, reader: Reader, independent: boolean) => Promise<Finding>;

/** The checks of a job that the browser makes itself, one after the other. */
export async function* checkJob(job: Job, account: Account | null, market: Market): AsyncGenerator<Finding> {
  const { reader, independent } = readerFor(account, market);
  for (const check of [checkContract, checkOwnOrder, checkSignature, checkFile("objective"), checkFile("result")] as Check[]) {
    try {
      yield await check(job, reader, independent);
    } catch (error) {
      yield { name: "open", holds: null, detail: String((error as Error).message ?? error) };
    }
  }
}

async function checkContract({ liability }: Job, reader: Reader, independent: boolean): Promise<Finding> {
  const { address } = liability;
  const [model, objective, result, promisee, promisor, token, cost, isFinalized, isSuccess] = await Promise.all([
    read(reader, address, "model").then(cidText),
    read(reader, address, "objective").then(cidText),
    read(reader, address, "result").then(cidText),
    read(reader, address, "promisee"),
    read(reader, address, "promisor"),
    read(reader, address, "token"),
    read(reader, address, "cost"),
    read(reader, address, "isFinalized"),
    read(reader, address, "isSuccess"),
  ]);
  const found = { model, objective, result, promisee, promisor, token, cost: String(cost), isFinalized, isSuccess };
  const said: Record<string, unknown> = { ...liability, token: liability.token.address };
  const wrong = Object.entries(found).filter(([name, value]) => said[name] !== value).map(([name]) => name);
  const where = independent ? texts.walletsNode : texts.serversNode;
  if (wrong.length) return { name: "contract", holds: false, detail: texts.contractDiffers(wrong.join(", "), where) };
  return { name: "contract", holds: independent ? true : null, detail: texts.contractAgrees(where, independent) };
}

async function checkOwnOrder(job: Job, reader: Reader): Promise<Finding> {
  const hash = String(await read(reader, job.liability.address, "demandHash")).slice(2);
  if (ownOrders().some((own) => own.hash === hash)) return { name: "order", holds: true, detail: texts.ownOrder };
  return { name: "order", holds: null, detail: texts.notOwnOrder };
}

async function checkSignature({ liability, resultMessage }: Job): Promise<Finding> {
  if (!resultMessage) return { name: "signature", holds: null, detail: texts.noResultMessage };
  const signer = await signerOf(resultHash(resultMessage), resultMessage.signature).catch(() => null);
  const belongs = resultMessage.liability === liability.address && (!liability.result || resultMessage.result === liability.result);
  if (signer !== liability.promisor || !belongs) return { name: "signature", holds: false, detail: texts.wrongSignature };
  return { name: "signature", holds: true, detail: texts.rightSignature(signer) };
}

function checkFile(which: "objective" | "result"): Check {
  return async ({ liability }) => {
    const cid = liability[which];
    if (!cid) return { name: which, holds: null, detail: texts.noFile };
    const found = await cidOf(await getBytes(cid, LARGEST));
    return { name: which, holds: found === cid, detail: found === cid ? texts.fileMatches(found) : texts.fileDiffers(found, cid) };
  };
}

/** Throws `ServerLies` unless an answer is signed by the account that the server names, for the account that asked. */
export async function checkAnswer(answer: Answer, asker: Address): Promise<void> {
  const signer = await signerOf(resultHash(answer), answer.signature).catch(() => null);
  if (signer !== answer.signer || answer.liability !== asker) throw new ServerLies(texts.lieAnswer);
  const found = await cidOf(await getBytes(answer.result, LARGEST));
  if (found !== answer.result) throw new ServerLies(texts.fileDiffers(found, answer.result));
}

/** Throws `ServerLies` if the objective that the server stored is not the file that was sent. */
export async function checkUpload(file: Uint8Array, cid: string): Promise<void> {
  if ((await cidOf(file)) !== cid) throw new ServerLies(texts.lieUpload);
}
