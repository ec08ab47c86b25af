import { useEffect, useMemo, useRef, useState } from "preact/hooks";
import { zeroAddress } from "viem";
import { useApp, useData, wordsOf } from "../app";
import { isCid } from "../cid";
import { amount, duration, ether, plain } from "../format";
import { parseAmount } from "../numbers";
import { blocksOf, contractsOf, orderLocally, prepare, signAndPost } from "../ordering";
import type { Prepared, Wish } from "../ordering";
import { calls } from "../contracts";
import { texts } from "../texts";
import { allowedContract, rememberContract } from "../trust";
import type { AccountState, Agent, Model } from "../types";
import { Action, Badge, Dialog, Facts, Field, Name, NumberField, Problem, Show, Strange } from "../ui";
import { inWords } from "../values";
import { Fit, ObjectiveChoice, firstChoice, useObjective, withoutDescription } from "./objective";
import { NOBODY, ValidatorChoice } from "./validator";
import type { Judge } from "./validator";

const LIFETIMES = [5, 60, 720];

/** The page for ordering: a model, an objective, a price, a signature. */
export function OrderPage(props: { model: string }) {
  const [model, setModel] = useState(props.model);
  const described = useData<Model>(model ? `models/${model}` : null);
  const isMissing = described.error !== null && described.data === null;
  const known = useMemo(() => described.data ?? (isMissing ? withoutDescription(model) : null), [described.data, isMissing, model]);
  return (
    <div class="order">
      <h1>{texts.orderTitle}</h1>
      <section class="step">
        <h2><span class="count">1</span> {texts.chooseModel}</h2>
        <ModelChoice model={model} choose={setModel} />
      </section>
      {model ? <Show of={described}>{() => null}</Show> : null}
      {model && known ? <OrderForm key={`${model} ${known.described}`} model={known} /> : null}
    </div>
  );
}

function ModelChoice(props: { model: string; choose: (cid: string) => void }) {
  const agents = useData<{ agents: Agent[] }>("agents");
  const [other, setOther] = useState("");
  const type = (text: string) => {
    setOther(text);
    if (isCid(text)) props.choose(text);
  };
  const pick = (cid: string) => {
    setOther("");
    props.choose(cid);
  };
  const robots = agents.data?.agents.filter((agent) => agent.models.length) ?? [];
  const models = [...new Set(robots.flatMap((robot) => robot.models))];
  if (props.model && !models.includes(props.model)) models.unshift(props.model);
  return (
    <>
      <Show of={agents}>
        {() => (
          <div class="cards" role="group" aria-label={texts.chooseModel}>
            {models.map((cid) => (
              <ModelCard key={cid} cid={cid} chosen={cid === props.model} robots={robots.filter((robot) => robot.models.includes(cid))} choose={pick} />
            ))}
            {!models.length ? <p class="quiet">{texts.noRobots}</p> : null}
          </div>
        )}
      </Show>
      <details class="more">
        <summary>{texts.otherModel}</summary>
        <Field label={texts.modelCid} error={other && !isCid(other) ? texts.notACid : ""} hint={texts.modelCidHint}>
          {(id, described) => (
            <input id={id} aria-describedby={described} class="wide" value={other} spellcheck={false} onInput={(event) => type(event.currentTarget.value.trim())} />
          )}
        </Field>
      </details>
    </>
  );
}

function ModelCard(props: { cid: string; chosen: boolean; robots: Agent[]; choose: (cid: string) => void }) {
  const model = useData<Model>(`models/${props.cid}`).data;
  const { market } = useApp();
  const description = model?.description;
  const best = props.robots.flatMap((robot) => robot.offers).filter((offer) => offer.model === props.cid && offer.token === market.token.address)
    .reduce<bigint | null>((least, offer) => (least === null || BigInt(offer.cost) < least ? BigInt(offer.cost) : least), null);
  const done = props.robots.reduce((sum, robot) => sum + robot.record.done, 0);
  const failed = props.robots.reduce((sum, robot) => sum + robot.record.failed, 0);
  return (
    <button type="button" class={`card ${props.chosen ? "chosen" : ""}`} aria-pressed={props.chosen} onClick={() => props.choose(props.cid)}>
      <strong><Strange text={description?.title ?? texts.undescribed} most={80} /></strong>
      <span class="about"><Strange text={description?.description ?? model?.text ?? props.cid} most={160} /></span>
      <span class="meta">
        {best !== null ? <Badge kind="calm">{texts.offered(amount(best, market.token))}</Badge> : description?.price ? <Badge kind="calm">{texts.typically(plain(description.price, 40))}</Badge> : null}
        {description?.seconds ? <Badge kind="calm">{duration(description.seconds)}</Badge> : null}
        <Badge kind={props.robots.some((robot) => robot.health === "alive") ? "good" : "calm"}>{texts.robotsPresent(props.robots.length)}</Badge>
        {done + failed ? <Badge kind={failed > done ? "warn" : "good"}>{texts.recordShort(done, failed)}</Badge> : null}
      </span>
    </button>
  );
}

/** The price that a description calls typical, for the form; empty if it is in another unit. */
function typicalPrice(price: string | undefined, symbol: string): string {
  const [number, unit] = (price ?? "").split(" ");
  return unit === symbol ? number : "";
}

function OrderForm({ model }: { model: Model }) {
  const { market, account } = useApp();
  const [choice, setChoice] = useState(() => firstChoice(model));
  const [price, setPrice] = useState(typicalPrice(model.description?.price, market.token.symbol) || "1");
  const [minutes, setMinutes] = useState<number | null>(null);
  const [judge, setJudge] = useState<Judge | null>(NOBODY);
  const make = useObjective(model, choice);
  const cost = parseAmount(price, market.token.decimals);
  const wish = useMemo<Wish | null>(() => {
    if (make === null || cost === null || judge === null) return null;
    return { model, objective: make, cost, validator: judge.address, validatorFee: judge.fee, minutes, confirm: judge.confirm };
  }, [make, cost, minutes, judge]);
  return (
    <>
      <section class="step">
        <h2><span class="count">2</span> {texts.chooseObjective}</h2>
        <ObjectiveChoice model={model} choice={choice} make={make} change={setChoice} />
      </section>
      <section class="step">
        <h2><span class="count">3</span> {texts.choosePrice}</h2>
        <div class="fields">
          <NumberField label={texts.youPay(plain(market.token.symbol, 12))} text={price} change={setPrice} error={cost === null ? texts.notAnAmount : ""} hint={texts.youPayHint} class="big number" />
          <Field label={texts.waitFor} hint={texts.waitForHint}>
            {(id, described) => (
              <select id={id} aria-describedby={described} class="big" value={minutes ?? ""} onChange={(event) => setMinutes(Number(event.currentTarget.value) || null)}>
                <option value="">{duration(market.defaultLifetime * (market.blockTime || 1))}</option>
                {LIFETIMES.filter((one) => blocksOf(one, market) <= market.limits.lifetime).map((one) => <option key={one} value={one}>{duration(one * 60)}</option>)}
              </select>
            )}
          </Field>
        </div>
        <ValidatorChoice choose={setJudge} />
        {account ? <OrderButton wish={wish} /> : <p class="callout">{texts.connectFirst}</p>}
      </section>
    </>
  );
}

/** Names what stands in the way of an order, each with a button that removes it; then the order's button. */
export function OrderButton(props: { wish: Wish | null }) {
  const { market, account, fixChain, send, notify, reloadMarket } = useApp();
  const state = useData<AccountState>(account ? `accounts/${account.address}` : null);
  const [review, setReview] = useState<Prepared | null>(null);
  const [error, setError] = useState<unknown>(null);
  const [known, setKnown] = useState(() => allowedContract(market));
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
  if (!account) return null;
  const needs = wish && state.data ? needsOf(wish, state.data, market.token.address === market.xrt.address) : [];
  const wrongChain = account.kind === "wallet" && account.chainId !== market.chainId;
  const short = needs.filter((need) => need.missing > 0n);
  const unallowed = account.kind === "wallet" && !wrongChain ? needs.filter((need) => need.missing <= 0n && need.unallowed) : [];
  const blocked = !wish || !state.data || wrongChain || short.length > 0 || unallowed.length > 0;
  const open = async () => {
    setError(null);
    const prepared = await prepare(wish!, account, market).catch((problem) => {
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
          <p class="row">
            <Action class="button small" run={async () => { await navigator.clipboard.writeText(account.address); notify(texts.copied); }}>{texts.copyAddress}</Action>
            <Action class="button small quietly" run={state.reload}>{texts.checkAgain}</Action>
          </p>
        </div>
      ))}
      {unallowed.map((need) => (
        <div class={`callout ${known && known !== market.factory ? "warn" : ""}`} key={need.token}>
          {BigInt(state.data!.eth) === 0n ? (
            <>
              <p>{texts.noGas(ether(state.data!.eth))}</p>
              <p class="row">
                <Action class="button small" run={async () => { await navigator.clipboard.writeText(account.address); notify(texts.copied); }}>{texts.copyAddress}</Action>
                <Action class="button small quietly" run={state.reload}>{texts.checkAgain}</Action>
              </p>
            </>
          ) : known && known !== market.factory ? (
            <>
              <p>{texts.otherContract} <Name text={known} /> → <Name text={market.factory} /></p>
              <Action class="button quietly" run={async () => trust()}>{texts.useOtherContract}</Action>
            </>
          ) : (
            <>
              <p>{texts.mustAllow(amount(need.amount, market[need.token]))} <Name text={market.factory} /></p>
              <Action class="button" id="allow" run={() => allow(need)}>{texts.allow(amount(need.amount, market[need.token]))}</Action>
            </>
          )}
        </div>
      ))}
      {account.kind === "local" ? <p class="callout warn">{texts.localSigns}</p> : null}
      {error ? <Problem error={error} /> : null}
      <Action id="order" class="button huge" disabled={blocked} run={open} onError={setError}>
        {account.kind === "local" ? texts.reviewLocal : texts.review}
      </Action>
      <Dialog title={account.kind === "local" ? texts.whatYouOrder : texts.whatYouSign} open={review !== null && isCurrent(review)} onClose={() => setReview(null)}>
        {review ? <Review of={review} isWanted={() => opened.current === review && isCurrent(review)} close={() => setReview(null)} /> : null}
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

function needsOf(draft: Wish, state: AccountState, sameToken: boolean): Need[] {
  const need = (token: "token" | "xrt", amount: bigint): Need => {
    const balance = BigInt(state[token].balance);
    return { token, amount, balance, missing: amount - balance, unallowed: BigInt(state[token].allowance) < amount };
  };
  if (sameToken) return [need("token", draft.cost + draft.validatorFee)];
  return [need("token", draft.cost), need("xrt", draft.validatorFee)];
}

/** The terms exactly as they are signed, the objective's values in words, and the hash that the browser made of them. */
function Review(props: { of: Prepared; isWanted: () => boolean; close: () => void }) {
  const { block } = useApp();
  const { draft, demand, hash, market, account, objective, wish } = props.of;
  const [error, setError] = useState("");
  const sign = async () => {
    setError("");
    const order = demand ? await signAndPost(demand, hash!, account, props.isWanted) : await orderLocally(draft, account.address, market);
    props.close();
    location.hash = `#/order/${order}`;
  };
  const left = demand ? Number(demand.deadline) - block : draft.lifetime;
  return (
    <>
      <p>{demand ? texts.whatYouSignHint : texts.whatYouOrderHint}</p>
      <InWords of={props.of} />
      <Facts
        of={[
          [texts.youPayShort, <strong>{amount(draft.cost, market.token)}</strong>],
          [texts.account, <Name text={account.address} label={account.address} />],
          [texts.model, <><Strange text={wish.model.description?.title ?? texts.undescribed} most={80} /> <Name text={draft.model} label={draft.model} /></>],
          [texts.objective, <Name text={draft.objective} label={draft.objective} />],
          [texts.market, <><Strange text={market.lighthouse.name} /> <Name text={market.lighthouse.address} /></>],
          [texts.token, <Name text={market.token.address} />],
          [texts.validator, draft.validator === zeroAddress ? texts.none : <Name text={draft.validator} label={draft.validator} />],
          [texts.validatorFee, amount(draft.validatorFee, market.xrt)],
          [texts.validUntil, left > 0 ? texts.blockIn(block + left, duration(left * market.blockTime)) : texts.orderState.expired],
          [texts.nonce, demand ? <code class="break">{String(demand.nonce)}</code> : ""],
          [texts.hash, hash ? <code class="break" id="hash">{hash}</code> : ""],
        ]}
      />
      {error ? <p class="problem" role="alert">{error}</p> : null}
      <p class="row">
        <Action id="sign" class="button huge" disabled={!objective.preflight.ok || left <= 0} run={sign} onError={(problem) => setError(wordsOf(problem))}>{demand ? texts.sign : texts.orderLocal}</Action>
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
      <h3>{texts.whatItDoes}</h3>
      {objective.cid === model.cid ? <p>{texts.withoutObjective}</p> : <Fit objective={objective} described={model.described} />}
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
