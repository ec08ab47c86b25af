import { useEffect, useState } from "preact/hooks";
import { useApp, useData, useTopic } from "../app";
import { amount, duration } from "../format";
import { withdraw } from "../ordering";
import { texts } from "../texts";
import { checkOrder } from "../trust";
import type { PostedOrder } from "../types";
import { Action, Facts, Name, Problem, Show } from "../ui";
import { StatementList } from "./account";

/** An order from its publication to its contract; then the page of the job takes over. */
export function FollowPage(props: { hash: string }) {
  const { account } = useApp();
  const posted = useData<PostedOrder>(`orders/${props.hash}`);
  useTopic(`order/${props.hash}`, posted.reload);
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
        {({ order, state, statements }) => (
          <>
            {lie ? <Problem error={lie} /> : null}
            <Steps done={1} active={state === "open"} failed={state === "expired" || state === "withdrawn"} />
            <p class="lead" aria-live="polite">{texts.orderStateLong[state]}</p>
            <StatementList statements={statements} />
            <OrderFacts order={order} />
            {state === "open" && account?.address === order.signer ? (
              <p class="row">
                <Action id="withdraw" class="button quietly" run={async () => { await withdraw(order, account); posted.reload(); }}>{texts.withdrawOrder}</Action>
                <span class="hint">{texts.withdrawHint}</span>
              </p>
            ) : null}
            {state !== "open" ? <a class="button" href={`#/order/model/${order.model}`}>{texts.orderAgain}</a> : null}
          </>
        )}
      </Show>
    </>
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
