import { useMemo, useState } from "preact/hooks";
import { zeroAddress } from "viem";
import type { Hex } from "viem";
import { useApp, useData, wordsOf } from "../app";
import { isCid } from "../cid";
import { amount, duration, ether, parseAmount, plain } from "../format";
import type { Demand } from "../messages";
import { orderLocally, prepare, signAndPost } from "../ordering";
import type { Draft } from "../ordering";
import { calls } from "../contracts";
import { texts } from "../texts";
import { allowedContract, rememberContract } from "../trust";
import type { AccountState, Agent, Market, Model, Objective } from "../types";
import { Action, Badge, Dialog, Facts, Field, Name, Problem, Show, Strange } from "../ui";
import { ObjectiveChoice } from "./objective";
import { NOBODY, ValidatorChoice } from "./validator";
import type { Judge } from "./validator";

const LIFETIMES = [5, 10, 60, 720];

/** The page for ordering: a model, an objective, a price, a signature. */
export function OrderPage(props: { model: string }) {
  const [model, setModel] = useState(props.model);
  const [objective, setObjective] = useState<Objective | null>(null);
  const described = useData<Model>(model ? `models/${model}` : null);
  return (
    <div class="order">
      <h1>{texts.orderTitle}</h1>
      <section class="step">
        <h2><span class="count">1</span> {texts.chooseModel}</h2>
        <ModelChoice model={model} choose={(cid) => { setModel(cid); setObjective(null); }} />
      </section>
      {model ? (
        <section class="step">
          <h2><span class="count">2</span> {texts.chooseObjective}</h2>
          <Show of={described}>{() => null}</Show>
          <ObjectiveChoice
            key={`${model} ${described.data?.described}`}
            model={described.data ?? { cid: model, described: false, description: null, text: null }}
            objective={objective}
            choose={setObjective}
          />
        </section>
      ) : null}
      {model && objective ? (
        <section class="step">
          <h2><span class="count">3</span> {texts.choosePrice}</h2>
          <PriceAndSign key={model} model={model} objective={objective} price={described.data?.description?.price} />
        </section>
      ) : null}
    </div>
  );
}

function ModelChoice(props: { model: string; choose: (cid: string) => void }) {
  const agents = useData<{ agents: Agent[] }>("agents");
  const [other, setOther] = useState("");
  const robots = agents.data?.agents.filter((agent) => agent.models.length) ?? [];
  const models = [...new Set(robots.flatMap((robot) => robot.models))];
  if (props.model && !models.includes(props.model)) models.unshift(props.model);
  return (
    <>
      <Show of={agents}>
        {() => (
          <div class="cards" role="group" aria-label={texts.chooseModel}>
            {models.map((cid) => (
              <ModelCard key={cid} cid={cid} chosen={cid === props.model} robots={robots.filter((robot) => robot.models.includes(cid))} choose={props.choose} />
            ))}
            {!models.length ? <p class="quiet">{texts.noRobots}</p> : null}
          </div>
        )}
      </Show>
      <details class="more">
        <summary>{texts.otherModel}</summary>
        <Field label={texts.modelCid} error={other && !isCid(other) ? texts.notACid : ""} hint={texts.modelCidHint}>
          {(id, described) => (
            <span class="row">
              <input id={id} aria-describedby={described} class="wide" value={other} spellcheck={false} onInput={(event) => setOther(event.currentTarget.value.trim())} />
              <button type="button" class="button small" disabled={!isCid(other)} onClick={() => props.choose(other)}>{texts.take}</button>
            </span>
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

/** For how many blocks an order is valid that waits so long. */
function blocksOf(minutes: number, market: Market): number {
  return Math.max(2, Math.round((minutes * 60) / Math.max(market.blockTime, 0.1)));
}

function PriceAndSign(props: { model: string; objective: Objective; price?: string }) {
  const { market, account } = useApp();
  const [price, setPrice] = useState(typicalPrice(props.price, market.token.symbol) || "1");
  const [minutes, setMinutes] = useState(10);
  const [judge, setJudge] = useState<Judge | null>(NOBODY);
  const cost = parseAmount(price, market.token.decimals);
  const draft = useMemo<Draft | null>(() => {
    if (cost === null || judge === null) return null;
    return {
      model: props.model, objective: props.objective.cid, cost, validatorFee: judge.fee,
      validator: judge.address, lifetime: minutes === 10 ? market.defaultLifetime : blocksOf(minutes, market),
    };
  }, [price, minutes, judge, props.model, props.objective.cid]);
  return (
    <>
      <div class="fields">
        <Field label={texts.youPay(plain(market.token.symbol, 12))} error={cost === null ? texts.notAnAmount : ""} hint={texts.youPayHint}>
          {(id, described) => <input id={id} aria-describedby={described} class="big number" inputMode="decimal" value={price} onInput={(event) => setPrice(event.currentTarget.value)} />}
        </Field>
        <Field label={texts.waitFor} hint={texts.waitForHint}>
          {(id, described) => (
            <select id={id} aria-describedby={described} class="big" value={minutes} onChange={(event) => setMinutes(Number(event.currentTarget.value))}>
              {LIFETIMES.filter((one) => one <= 10 || blocksOf(one, market) <= market.limits.lifetime).map((one) => <option key={one} value={one}>{duration(one * 60)}</option>)}
            </select>
          )}
        </Field>
      </div>
      <ValidatorChoice choose={setJudge} />
      {account ? <OrderButton draft={draft} /> : <p class="callout">{texts.connectFirst}</p>}
    </>
  );
}

/** Names what stands in the way of an order, each with a button that removes it; then the order's button. */
export function OrderButton(props: { draft: Draft | null }) {
  const { market, account, fixChain, send, notify } = useApp();
  const state = useData<AccountState>(account ? `accounts/${account.address}` : null);
  const [review, setReview] = useState<{ demand: Demand; hash: Hex } | null>(null);
  const [error, setError] = useState<unknown>(null);
  const [known, setKnown] = useState(() => allowedContract(market));
  const { draft } = props;
  if (!account) return null;
  const needs = draft && state.data ? needsOf(draft, state.data, market.token.address === market.xrt.address) : [];
  const wrongChain = account.kind === "wallet" && account.chainId !== market.chainId;
  const short = needs.filter((need) => need.missing > 0n);
  const unallowed = account.kind === "wallet" && !wrongChain ? needs.filter((need) => need.missing <= 0n && need.unallowed) : [];
  const blocked = !draft || !state.data || wrongChain || short.length > 0 || unallowed.length > 0;
  const open = async () => {
    setError(null);
    if (account.kind === "local") location.hash = `#/order/${await orderLocally(draft!, account.address, market)}`;
    else setReview(await prepare(draft!, account.address));
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
        {account.kind === "local" ? texts.orderLocal : texts.review}
      </Action>
      <Dialog title={texts.whatYouSign} open={review !== null} onClose={() => setReview(null)}>
        {review ? <Review {...review} close={() => setReview(null)} /> : null}
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

function needsOf(draft: Draft, state: AccountState, sameToken: boolean): Need[] {
  const need = (token: "token" | "xrt", amount: bigint): Need => {
    const balance = BigInt(state[token].balance);
    return { token, amount, balance, missing: amount - balance, unallowed: BigInt(state[token].allowance) < amount };
  };
  if (sameToken) return [need("token", draft.cost + draft.validatorFee)];
  return [need("token", draft.cost), need("xrt", draft.validatorFee)];
}

/** The terms exactly as they are signed, and the hash that the browser made of them. */
function Review(props: { demand: Demand; hash: Hex; close: () => void }) {
  const { market, account, block } = useApp();
  const { demand, hash } = props;
  const [error, setError] = useState("");
  const sign = async () => {
    setError("");
    const order = await signAndPost(demand, hash, account!);
    props.close();
    location.hash = `#/order/${order}`;
  };
  const left = Number(demand.deadline) - block;
  return (
    <>
      <p>{texts.whatYouSignHint}</p>
      <Facts
        of={[
          [texts.youPayShort, <strong>{amount(demand.cost, market.token)}</strong>],
          [texts.model, <Name text={demand.model} label={demand.model} />],
          [texts.objective, <Name text={demand.objective} label={demand.objective} />],
          [texts.market, <><Strange text={market.lighthouse.name} /> <Name text={demand.lighthouse} /></>],
          [texts.token, <Name text={demand.token} />],
          [texts.validator, demand.validator === zeroAddress ? texts.none : <Name text={demand.validator} />],
          [texts.validatorFee, amount(demand.validatorFee, market.xrt)],
          [texts.validUntil, texts.blockIn(Number(demand.deadline), duration(left * market.blockTime))],
          [texts.nonce, <code class="break">{String(demand.nonce)}</code>],
          [texts.hash, <code class="break" id="hash">{hash}</code>],
        ]}
      />
      {error ? <p class="problem" role="alert">{error}</p> : null}
      <p class="row">
        <Action id="sign" class="button huge" run={sign} onError={(problem) => setError(wordsOf(problem))}>{texts.sign}</Action>
        <button type="button" class="button quietly" onClick={props.close}>{texts.notNow}</button>
      </p>
    </>
  );
}
