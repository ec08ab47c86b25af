import { useEffect, useMemo, useRef, useState } from "preact/hooks";
import { zeroAddress } from "viem";
import type { Address } from "viem";
import { post } from "../api";
import type { Account } from "../app";
import { forgetTyped, isUnreachable, useApp, useData, useReturn, useTyped, wordsOf } from "../app";
import { calls } from "../contracts";
import { amount, duration, ether, plain } from "../format";
import { parseAmount } from "../numbers";
import { RobotDeclined, blocksOf, contractsOf, neededFor, orderLocally, prepare, priceOf, signAndPost } from "../ordering";
import type { Prepared, Wish } from "../ordering";
import { PermitRefused, PermitUsed, domainOf, permitWords } from "../permits";
import type { Domain } from "../permits";
import { texts } from "../texts";
import { allowedContract, readerFor, rememberContract } from "../trust";
import type { AccountState, Market, Model, Quote } from "../types";
import { Action, Copy, Dialog, Facts, Field, Name, NumberField, Picture, Problem, Show, Strange } from "../ui";
import { inWords } from "../values";
import { Fit, ObjectiveChoice, firstChoice, useObjective, withoutDescription } from "./objective";
import type { Make } from "./objective";
import { Title, nameOf, recordOf } from "./robots";
import { NOBODY, ValidatorChoice } from "./validator";
import type { Judge } from "./validator";

const LIFETIMES = [5, 60, 720];

/** The page for ordering what a model describes: say how, choose who, look at it, sign. */
export function OrderPage(props: { model: string; robot: string; objective: string }) {
  const { model } = props;
  const described = useData<Model>(`models/${model}`);
  const isMissing = described.error !== null && described.data === null && !isUnreachable(described.error);
  const known = useMemo(() => described.data ?? (isMissing ? withoutDescription(model) : null), [described.data, isMissing, model]);
  const description = known?.description;
  return (
    <div class="order">
      <p class="back"><a href="#/">{texts.otherRobots}</a></p>
      <h1>{known ? <Title of={description} /> : texts.loading}</h1>
      {description?.description ? <p class="lead"><Strange text={description.description} /></p> : null}
      <Show of={described}>{() => null}</Show>
      {known ? <OrderForm key={`${known.described}`} model={known} robot={props.robot} objective={props.objective} /> : null}
    </div>
  );
}

/** The price that a description calls typical, for the form; empty if it is in another unit. */
export function typicalPrice(price: string | undefined, symbol: string): string {
  const [number, unit] = (price ?? "").split(" ");
  return unit === symbol ? number : "";
}

/** Who is to do it; null until the person or the quotes have said. */
type Choosing = Address | "" | null;

function OrderForm({ model, robot, objective }: { model: Model; robot: string; objective: string }) {
  const { market, account } = useApp();
  const [choice, setChoice] = useTyped(`choice ${model.described}`, () => (objective ? { ...firstChoice(model), way: "cid" as const, cid: objective } : firstChoice(model)));
  const [price, setPrice] = useTyped("price", () => typicalPrice(model.description?.price, market.token.symbol) || "1");
  const [minutes, setMinutes] = useTyped<number | null>("minutes", () => null);
  const [judge, setJudge] = useState<Judge | null>(NOBODY);
  const [chosen, choose] = useTyped<Choosing>("chosen", () => null);
  const make = useObjective(model, choice);
  const { quotes, problem, ask } = useQuotes(model, make);
  const fitting = quotes?.filter((quote) => isUsable(quote, market.token.address)) ?? [];
  const isThere = chosen === "" || fitting.some((one) => one.agent === chosen);
  const wanted = isThere ? chosen : (fitting.find((quote) => quote.agent === robot) ?? fitting[0])?.agent ?? (quotes ? "" : null);
  const quote = fitting.find((one) => one.agent === wanted);
  const offered = parseAmount(price, market.token.decimals);
  const cost = wanted ? (quote ? BigInt(quote.cost) : null) : offered;
  const wish = useMemo<Wish | null>(() => {
    if (make === null || cost === null || judge === null || wanted === null) return null;
    return { model, objective: make, robot: wanted, cost, validator: judge.address, validatorFee: judge.fee, minutes, confirm: judge.confirm };
  }, [make, cost, minutes, judge, wanted]);
  return (
    <>
      <section class="step">
        <h2>{texts.chooseObjective}</h2>
        <ObjectiveChoice model={model} choice={choice} make={make} change={setChoice} />
      </section>
      <section class="step">
        <h2>{texts.chooseRobot}</h2>
        {problem ? <Problem error={problem} /> : null}
        <Robots quotes={quotes} asking={make !== null} wanted={wanted} choose={choose} again={ask} />
        {wanted === "" ? (
          <div class="fields">
            <NumberField label={texts.youPay(plain(market.token.symbol, 32))} text={price} change={setPrice} error={offered === null ? texts.notAnAmount : ""} hint={texts.youPayHint} class="big number" />
            <Field label={texts.waitFor} hint={texts.waitForHint}>
              {(id, described) => (
                <select id={id} aria-describedby={described} class="big" value={minutes ?? ""} onChange={(event) => setMinutes(Number(event.currentTarget.value) || null)}>
                  <option value="">{duration(market.defaultLifetime * (market.blockTime || 1))}</option>
                  {LIFETIMES.filter((one) => blocksOf(one, market) <= market.limits.lifetime).map((one) => <option key={one} value={one}>{duration(one * 60)}</option>)}
                </select>
              )}
            </Field>
          </div>
        ) : null}
        <ValidatorChoice choose={setJudge} />
        {account ? <OrderButton wish={wish} declined={(one) => { choose(null); ask(); return one; }} /> : <p class="callout">{texts.connectFirst}</p>}
      </section>
    </>
  );
}

export const isUsable = (quote: Quote, token: Address) => !quote.code && quote.token.address === token && !quote.validator;

/** Milliseconds without a key after which robots are asked. */
const SETTLED = 500;

/** What the robots of a model want for an objective; null until they have answered. */
function useQuotes(model: Model, make: Make | null): { quotes: Quote[] | null; problem: unknown; ask: () => void } {
  const [found, setFound] = useState<{ of: Make; quotes: Quote[]; problem?: unknown } | null>(null);
  const [turn, setTurn] = useState(0);
  useEffect(() => {
    if (make === null) return;
    let current = true;
    const timer = setTimeout(async () => {
      try {
        const objective = await make().catch(() => null); // what is wrong with it is said where it is chosen
        const { quotes } = objective?.preflight.ok ? await post<{ quotes: Quote[] }>("quotes", { model: model.cid, objective: objective.cid }) : { quotes: [] };
        if (current) setFound({ of: make, quotes });
      } catch (problem) {
        if (current) setFound({ of: make, quotes: [], problem });
      }
    }, SETTLED);
    return () => {
      current = false;
      clearTimeout(timer);
    };
  }, [make, turn]);
  const known = found?.of === make ? found : null;
  const ask = () => setTurn((known) => known + 1);
  useReturn(known?.problem, ask);
  return { quotes: known?.quotes ?? null, problem: known?.problem, ask };
}

/** Who could do it, side by side: price, start, duration, record; the cheapest first, refusals last. */
function Robots(props: { quotes: Quote[] | null; asking: boolean; wanted: Choosing; choose: (who: Address | "") => void; again: () => void }) {
  const { market } = useApp();
  const { quotes, wanted, choose } = props;
  if (!props.asking) return <p class="quiet">{texts.sayFirst}</p>;
  if (quotes === null) return <p class="quiet" aria-busy="true">{texts.askingRobots}</p>;
  const ready = quotes.filter((quote) => isUsable(quote, market.token.address));
  const others = quotes.filter((quote) => !isUsable(quote, market.token.address));
  return (
    <>
      <div class="quotes" role="radiogroup" aria-label={texts.chooseRobot}>
        {ready.map((quote) => <QuoteRow key={quote.agent} quote={quote} chosen={wanted === quote.agent} choose={() => choose(quote.agent)} />)}
        <label class={`quote ${wanted === "" ? "chosen" : ""}`}>
          <input type="radio" name="robot" id="anybody" checked={wanted === ""} onChange={() => choose("")} />
          <span class="who"><strong>{texts.anybody}</strong><span class="quiet">{ready.length ? texts.anybodyHint : texts.nobodyQuotes}</span></span>
        </label>
      </div>
      {others.length ? (
        <ul class="plain refusals">
          {others.map((quote) => <li key={quote.agent}><Name text={quote.agent} href={`#/robot/${quote.agent}`} /> <Strange text={quote.code ? texts.declines(quote.detail || quote.code) : texts.wantsOther(amount(quote.cost, quote.token))} most={200} /></li>)}
        </ul>
      ) : null}
      <p><button type="button" class="button small quietly" onClick={props.again}>{texts.askAgain}</button></p>
    </>
  );
}

function QuoteRow({ quote, chosen, choose }: { quote: Quote; chosen: boolean; choose: () => void }) {
  const { market, robotAt } = useApp();
  const robot = robotAt(quote.agent);
  return (
    <label class={`quote ${chosen ? "chosen" : ""}`}>
      <input type="radio" name="robot" checked={chosen} onChange={choose} value={quote.agent} />
      <Picture address={quote.agent} cid={robot?.profile?.picture} size="small" />
      <span class="who">
        <strong>{robot ? nameOf(robot) : plain(quote.name, 80) || <Name text={quote.agent} />}</strong>
        <span class="quiet">{[quote.start ? texts.beginsIn(duration(quote.start)) : texts.beginsNow, quote.seconds ? texts.takes(duration(quote.seconds)) : "", recordOf(robot?.record ?? { done: 0, failed: 0 })].filter(Boolean).join(" · ")}</span>
      </span>
      <span class="price-tag">{amount(quote.cost, market.token)}</span>
    </label>
  );
}

/** Names what stands in the way of an order, each with a button that removes it; then the order's button. */
export function OrderButton(props: { wish: Wish | null; declined?: (error: RobotDeclined) => void }) {
  const { market, account, fixChain, send, notify, reloadMarket } = useApp();
  const state = useData<AccountState>(account ? `accounts/${account.address}` : null);
  const [review, setReview] = useState<Prepared | null>(null);
  const [error, setError] = useState<unknown>(null);
  const [known, setKnown] = useState(() => allowedContract(market));
  const [refused, setRefused] = useState("");
  const { wish } = props;
  const latest = useRef({ wish, account, market });
  latest.current = { wish, account, market };
  // What was looked at is shown, and can be signed, as long as nothing of what it was made from has changed.
  const isCurrent = (one: Prepared) => one.wish === latest.current.wish && one.account === latest.current.account && contractsOf(one.market) === contractsOf(latest.current.market);
  const opened = useRef<Prepared | null>(null);
  opened.current = review;
  useEffect(() => {
    if (!review || isCurrent(review)) return;
    setReview(null);
    notify(texts.changedLookAgain, "bad");
  });
  const wrongChain = account?.kind === "wallet" && account.chainId !== market.chainId;
  const isShort = wish !== null && state.data !== null && BigInt(state.data.token.allowance) < neededFor(wish, state.data, market);
  const domain = usePermits(state.data?.permits && !wrongChain && refused !== market.token.address ? account : null, market);
  if (!account) return null;
  const needs = wish && state.data ? needsOf(wish, state.data, market) : [];
  const short = needs.filter((need) => need.missing > 0n);
  // A permit takes the place of an allowance. Another contract than before needs the person's word for both.
  const isOther = known !== null && known !== market.factory;
  const asks = (need: Need) => need.missing <= 0n && (need.token === "token" && domain !== null ? isShort && isOther : need.unallowed);
  const asked = account.kind === "wallet" && !wrongChain ? needs.filter(asks) : [];
  const blocked = (isShort && domain === undefined) || !wish || !state.data || wrongChain || short.length > 0 || asked.length > 0;
  const open = async () => {
    setError(null);
    const prepared = await prepare(wish!, account, market, domain ?? null).catch((problem) => {
      reloadMarket();
      throw problem;
    });
    setReview(prepared);
  };
  const allow = async (need: Need) => {
    await send(market[need.token].address, calls.approve(market.factory, need.amount));
    trust();
    notify(texts.allowedNow(amount(need.amount, market[need.token])));
    state.reload();
  };
  const trust = () => {
    rememberContract(market);
    setKnown(market.factory);
  };
  const copyAddress = (
    <p class="row">
      <Copy text={account.address} label={texts.copyAddress} class="button small" />
      <Action class="button small quietly" run={state.reload}>{texts.checkAgain}</Action>
    </p>
  );
  return (
    <div class="sign">
      {state.error ? <Problem error={state.error} retry={state.reload} /> : null}
      {wrongChain ? (
        <div class="callout warn">
          <p>{texts.wrongChain(account.chainId, market.chainId)}</p>
          <Action class="button" id="fix-chain" run={fixChain}>{texts.switchChain}</Action>
        </div>
      ) : null}
      {short.map((need) => (
        <div class="callout warn" key={need.token}>
          <p>{texts.tooLittle(amount(need.balance, market[need.token]), amount(need.amount, market[need.token]))}</p>
          {copyAddress}
        </div>
      ))}
      {asked.map((need) => (
        <div class={`callout ${isOther ? "warn" : ""}`} key={need.token}>
          {isOther ? (
            <>
              <p>{texts.otherContract} <Name text={known} /> → <Name text={market.factory} /></p>
              <Action class="button quietly" run={async () => trust()}>{texts.useOtherContract}</Action>
            </>
          ) : BigInt(state.data!.eth) === 0n ? (
            <>
              <p>{texts.noGas(ether(state.data!.eth))}</p>
              {copyAddress}
            </>
          ) : (
            <>
              <p>{texts.mustAllow(amount(need.amount, market[need.token]))} <Name text={market.factory} /></p>
              <Action class="button" id="allow" run={() => allow(need)}>{texts.allow(amount(need.amount, market[need.token]))}</Action>
            </>
          )}
        </div>
      ))}
      {error ? <Problem error={error} /> : null}
      <p class="total row between">
        <span>{wish ? <>{texts.youPayShort} <strong class="price-tag">{amount(wish.cost, market.token)}</strong></> : null}</span>
        <Action id="order" class="button huge" disabled={blocked} run={open} onError={setError}>
          {account.kind === "local" ? texts.reviewLocal : texts.review}
        </Action>
      </p>
      {account.kind === "local" ? <p class="hint">{texts.localSigns}</p> : null}
      <Dialog title={account.kind === "local" ? texts.whatYouOrder : texts.whatYouSign} open={review !== null && isCurrent(review)} onClose={() => setReview(null)}>
        {review ? <Review of={review} isWanted={() => opened.current === review && isCurrent(review)} close={() => setReview(null)} declined={props.declined} refused={() => { setRefused(market.token.address); setReview(null); notify(texts.permitRefused, "bad"); }} again={async () => { await open(); notify(texts.permitUsed); }} /> : null}
      </Dialog>
    </div>
  );
}

interface Need {
  token: "token" | "xrt";
  amount: bigint;
  balance: bigint;
  missing: bigint;
  unallowed: boolean;
}

/** The domain of the market's token for permits of a wallet; null without a wallet or if the token has none, undefined until that is known. */
function usePermits(account: Account | null, market: Market): Domain | null | undefined {
  const token = market.token.address;
  const signer = account?.kind === "wallet" ? account : null;
  const [found, setFound] = useState<{ signer: Account; token: Address; domain: Domain | null } | null>(null);
  useEffect(() => {
    let current = true;
    if (signer) domainOf(token, market.chainId, readerFor(signer, market).reader).then((domain) => current && setFound({ signer, token, domain }));
    return () => {
      current = false;
    };
  }, [signer, token, market.chainId]);
  if (!signer) return null;
  return found?.signer === signer && found.token === token ? found.domain : undefined;
}

function needsOf(draft: Wish, state: AccountState, market: Market): Need[] {
  const need = (token: "token" | "xrt", amount: bigint): Need => {
    const balance = BigInt(state[token].balance);
    return { token, amount, balance, missing: amount - balance, unallowed: BigInt(state[token].allowance) < amount };
  };
  const price = priceOf(draft, market);
  return [need("token", price), need("xrt", draft.cost + draft.validatorFee - price)];
}

/** What is ordered in words, and on demand the terms exactly as they are signed, with the hash that the browser made. */
function Review(props: { of: Prepared; isWanted: () => boolean; close: () => void; declined?: (error: RobotDeclined) => void; refused: () => void; again: () => Promise<void> }) {
  const { block, robotAt } = useApp();
  const { draft, demand, hash, permit, market, account, objective, wish } = props.of;
  const [error, setError] = useState("");
  const robot = draft.robot ? robotAt(draft.robot) : undefined;
  const sign = async () => {
    setError("");
    const order = demand ? await signAndPost(props.of, props.isWanted).catch((problem) => {
      if (problem instanceof PermitUsed) return props.again().then(() => null);
      throw problem;
    }) : await orderLocally(draft, account.address, market);
    if (order === null) return;
    props.close();
    forgetTyped();
    location.hash = `#/order/${order}`;
  };
  const failed = (problem: unknown) => {
    setError(wordsOf(problem));
    if (problem instanceof RobotDeclined) props.declined?.(problem);
    if (problem instanceof PermitRefused) props.refused();
  };
  const left = demand ? Number(demand.deadline) - block : draft.lifetime;
  const permitFee = draft.validator === zeroAddress ? draft.validatorFee : 0n;
  return (
    <>
      <InWords of={props.of} />
      <Facts
        of={[
          [texts.youPayShort, <strong>{amount(draft.cost, market.token)}</strong>],
          [texts.permitFee, permitFee ? amount(permitFee, market.token) : ""],
          [texts.inAll, permitFee ? <strong id="in-all">{amount(priceOf(draft, market), market.token)}</strong> : ""],
          [texts.to, draft.robot ? <>{robot ? <strong>{nameOf(robot)}</strong> : null} <Name text={draft.robot} label={draft.robot} /></> : texts.anybody],
          [texts.ifStopped, wish.model.description ? texts.stopCosts[wish.model.description.onStop ?? "refund"] : ""],
          [texts.validator, draft.validator === zeroAddress ? "" : <Name text={draft.validator} label={draft.validator} />],
          [texts.validatorFee, draft.validatorFee && !permitFee ? amount(draft.validatorFee, market.xrt) : ""],
        ]}
      />
      {permit ? <p class="callout" id="permit">{permitWords(permit, market.token)} {texts.permitFor} <Name text={permit.spender} label={permit.spender} /></p> : null}
      <p class="hint">{demand ? texts.whatYouSignHow(permit !== undefined, draft.robot !== "") : texts.whatYouOrderHint}</p>
      <details class="more" id="signed-terms" open={demand !== undefined}>
        <summary>{texts.termsAsSigned}</summary>
        <Facts
          of={[
            [texts.account, <Name text={account.address} label={account.address} />],
            [texts.model, <Name text={draft.model} label={draft.model} />],
            [texts.objective, <span id="objective"><Name text={draft.objective} label={draft.objective} href={`#/file/${draft.objective}`} /></span>],
            [texts.market, <><Strange text={market.lighthouse.name} /> <Name text={market.lighthouse.address} /></>],
            [texts.token, <Name text={market.token.address} />],
            [texts.validUntil, left > 0 ? texts.blockIn(block + left, duration(left * market.blockTime)) : texts.orderState.expired],
            [texts.nonce, demand ? <code class="break">{String(demand.nonce)}</code> : ""],
            [texts.hash, hash ? <code class="break" id="hash">{hash}</code> : ""],
          ]}
        />
      </details>
      {error ? <p class="problem" role="alert">{error}</p> : null}
      <p class="row">
        <Action id="sign" class="button huge" disabled={!objective.preflight.ok || left <= 0} run={sign} onError={failed}>{demand ? texts.sign : texts.orderLocal(amount(draft.cost, market.token))}</Action>
        <button type="button" class="button quietly" onClick={props.close}>{texts.notNow}</button>
      </p>
    </>
  );
}

/** What is in the objective that the order names, read from its file. */
function InWords({ of: { objective, messages, wish: { model } } }: { of: Prepared }) {
  const topics = model.description?.objective ?? [];
  const more = objective.summary.messages - messages.length;
  return (
    <section id="in-words">
      {objective.cid === model.cid ? <p>{texts.withoutObjective}</p> : objective.preflight.ok ? null : <Fit objective={objective} described={model.described} />}
      <ol class="in-words">
        {messages.map((message) => {
          const topic = topics.find((one) => one.topic === message.topic);
          const title = topic?.title || message.topic;
          const rows = message.cut ? [[title, `${plain(String(message.value), 600)} (${texts.cutValue})`]] : inWords(topic?.value ?? {}, message.value, title);
          return (
            <li key={message.number}>
              <h3><Strange text={title} most={80} />{messages.length > 1 ? ` · ${texts.atSecond.toLowerCase()} ${Number(message.at.toFixed(9))}` : ""}</h3>
              <dl class="facts">{rows.map(([name, words], place) => <div key={place}><dt><Strange text={name} most={80} /></dt><dd><Strange text={words} most={600} /></dd></div>)}</dl>
            </li>
          );
        })}
      </ol>
      {more > 0 ? <p><a href={`#/file/${objective.cid}`} target="_blank">{texts.notShown(more)}</a></p> : null}
    </section>
  );
}
