import { useEffect, useState } from "preact/hooks";
import { post } from "../api";
import { useApp, useData, useModel, useTopic } from "../app";
import { amount, duration, plain, short } from "../format";
import { Replay } from "../live";
import { permitForOpen, signForOpen, withdraw } from "../ordering";
import { permitWords } from "../permits";
import type { Permit } from "../permits";
import { texts } from "../texts";
import { checkAnswer, checkOrder } from "../trust";
import type { Answer, PostedOrder, Quote, Summary } from "../types";
import { Action, Badge, Facts, Name, Problem, Show } from "../ui";
import { StatementList } from "./account";
import { isUsable } from "./order";

/** An order from its publication to its contract; then the page of the job takes over. */
export function FollowPage(props: { hash: string }) {
  const { account } = useApp();
  const posted = useData<PostedOrder>(`orders/${props.hash}`, `order/${props.hash}`);
  useTopic("chain", () => (posted.data?.state ?? "open") === "open" && posted.reload());
  const [lie, setLie] = useState<unknown>(null);
  const { data } = posted;
  useEffect(() => {
    if (data) checkOrder(data.order).then(() => setLie(null), setLie);
  }, [data?.order.signature]);
  useEffect(() => {
    if (data?.liability) location.replace(`#/job/${data.liability}`);
  }, [data?.liability]);
  return (
    <>
      <h1>{texts.yourOrder}</h1>
      <Show of={posted}>
        {({ order, state, statements, answers }) => (
          <>
            {lie ? <Problem error={lie} /> : null}
            {BigInt(order.cost) ? <Steps done={1} active={state === "open"} failed={state === "expired" || state === "withdrawn"} /> : null}
            <p class="lead" aria-live="polite">{answers.length ? texts.answered : texts.orderStateLong[state]}</p>
            {answers.map((answer) => <AnswerView key={answer.signature} order={order} answer={answer} />)}
            <StatementList statements={statements} />
            {state === "open" && statements.some((one) => one.kind === "declined") ? <WhatWouldWork order={order} changed={posted.reload} /> : null}
            {state === "open" ? <AnotherPermit order={order} told={lastShort(statements)} /> : null}
            <OrderFacts order={order} />
            {state === "open" && account?.address === order.signer ? (
              <p class="row">
                <Action id="withdraw" class="button quietly" run={async () => { await withdraw(order, account); posted.reload(); }}>{texts.withdrawOrder}</Action>
                <span class="hint">{texts.withdrawHint}</span>
              </p>
            ) : null}
            {state !== "open" ? <a class="button" href={`#/order/model/${order.model}//${order.objective}`}>{texts.orderAgain}</a> : null}
          </>
        )}
      </Show>
    </>
  );
}

/** When a provider last said that the contracts may not take the price; 0 if none did. */
function lastShort(statements: PostedOrder["statements"]): number {
  return Math.max(0, ...statements.filter((one) => one.code === "ERC20InsufficientAllowance").map((one) => one.at));
}

/** Offers to sign a permit again, if providers have `told` that another order has used that of this one. */
function AnotherPermit({ order, told }: { order: PostedOrder["order"]; told: number }) {
  const { account, market, notify } = useApp();
  const [permit, setPermit] = useState<Permit | null>(null);
  const signer = told && order.token === market.token.address && account?.kind === "wallet" && account.chainId === market.chainId && account.address === order.signer ? account : null;
  useEffect(() => {
    let current = true;
    setPermit(null);
    if (signer) permitForOpen(signer, market).then((found) => current && setPermit(found), () => {});
    return () => {
      current = false;
    };
  }, [signer, told]);
  if (!signer || !permit) return null;
  const sign = async () => {
    await signForOpen(permit, signer, market).catch(async (problem) => {
      setPermit(await permitForOpen(signer, market));
      throw problem;
    });
    setPermit(null);
    notify(texts.permitSigned);
  };
  return (
    <div class="callout warn" id="another-permit">
      <p>{texts.permitUsedByOther}</p>
      <p>{permitWords(permit, market.token)} {texts.permitFor} <Name text={permit.spender} label={permit.spender} /></p>
      <Action id="sign-permit" class="button" run={sign}>{texts.signPermit}</Action>
    </div>
  );
}

/** What the robots want for an order that was declined: each with a button that orders it, and withdraws this one. */
function WhatWouldWork({ order, changed }: { order: PostedOrder["order"]; changed: () => void }) {
  const { account, market } = useApp();
  const [quotes, setQuotes] = useState<Quote[] | null>(null);
  useEffect(() => void post<{ quotes: Quote[] }>("quotes", { model: order.model, objective: order.objective }).then((found) => setQuotes(found.quotes), () => setQuotes([])), [order.hash]);
  const usable = (quotes ?? []).filter((quote) => isUsable(quote, market.token.address));
  if (account?.address !== order.signer || !usable.length) return null;
  const take = async (quote: Quote) => {
    await withdraw(order, account);
    changed();
    location.hash = `#/order/model/${order.model}/${quote.agent}/${order.objective}`;
  };
  return (
    <div class="callout">
      <p>{texts.whatWouldWork}</p>
      <p class="row">{usable.slice(0, 4).map((quote) => <Action key={quote.agent} class="button small" run={() => take(quote)}>{texts.orderFor(plain(quote.name, 60) || short(quote.agent), amount(quote.cost, quote.token))}</Action>)}</p>
    </div>
  );
}

/** An answer without a contract, checked by this browser. One to another question of this account is not shown. */
function AnswerView({ order, answer }: { order: PostedOrder["order"]; answer: Answer }) {
  const summary = useData<Summary>(`files/${answer.result}/summary`);
  const description = useModel(order.model)?.description ?? null;
  const [checked, setChecked] = useState<unknown>(null);
  useEffect(() => void checkAnswer(answer, order.signer).then(() => setChecked(true), setChecked), [answer.signature]);
  const question = summary.data?.metadata["aira-answer"]?.demand;
  if (question && question !== order.hash) return null;
  return (
    <section class="panel">
      <h2>{texts.answer}</h2>
      {checked !== null && checked !== true ? <Problem error={checked} /> : null}
      <p>
        {checked === true ? <Badge kind="good">{texts.holds}</Badge> : null} {texts.answeredBy} <Name text={answer.signer} href={`#/account/${answer.signer}`} />
      </p>
      <Replay cid={answer.result} model={description} />
    </section>
  );
}

function OrderFacts({ order }: { order: PostedOrder["order"] }) {
  const { market, block } = useApp();
  const left = order.deadline - block;
  return (
    <Facts
      of={[
        [texts.price, amount(order.cost, market.token)],
        [texts.model, <Name text={order.model} />],
        [texts.objective, <Name text={order.objective} href={`#/file/${order.objective}`} />],
        [texts.by, <Name text={order.signer} />],
        [texts.validUntil, left > 0 ? texts.blockIn(order.deadline, duration(left * market.blockTime)) : texts.block(order.deadline)],
        [texts.hash, <code class="break">{order.hash}</code>],
      ]}
    />
  );
}

/** How far a job is, from the order to the payment. */
export function Steps(props: { done: number; active?: boolean; failed?: boolean; share?: number }) {
  return (
    <ol class="steps">
      {texts.steps.map((name, place) => {
        const state = place < props.done ? "done" : place === props.done ? (props.failed ? "failed" : props.active ? "active" : "") : "";
        return (
          <li key={name} class={state} aria-current={place === props.done && props.active ? "step" : undefined}>
            <span class="mark" aria-hidden="true">{state === "done" ? "✓" : state === "failed" ? "×" : place + 1}</span>
            <span>{name}</span>
            {state === "active" && props.share !== undefined ? <progress value={props.share} max={1} aria-label={texts.playback} /> : null}
          </li>
        );
      })}
    </ol>
  );
}
