import { useEffect, useState } from "preact/hooks";
import { isAddress } from "viem";
import type { Address } from "viem";
import { ApiError, post } from "../api";
import { useApp, useData, useModel, useTopic } from "../app";
import { amount, clock, plain } from "../format";
import { Readings } from "../live";
import { texts } from "../texts";
import type { Agent, Entry, Liability, OwnerRules, Token } from "../types";
import { Action, Dialog, Facts, Field, Name, NumberField, Picture, Show, Strange } from "../ui";
import { JobTable } from "./account";
import { Doing, nameOf, priceOf } from "./robots";
import { Health, Log, OperatorLogin } from "./services";

/** One robot: who it is, what it reads, what it did; and for its owner, how it is run. */
export function RobotPage(props: { address: string }) {
  const { agents, robotAt } = useApp();
  const robot = robotAt(props.address);
  if (robot) return <RobotView robot={robot} />;
  if (agents === null) return <p class="quiet" aria-busy="true">{texts.loading}</p>;
  return (
    <div class="empty">
      <h1>{texts.robotAway}</h1>
      <p><Name text={props.address} href={`#/account/${props.address}`} /></p>
      <p><a class="button" href="#/">{texts.otherRobots}</a></p>
    </div>
  );
}

function RobotView({ robot }: { robot: Agent }) {
  const { market } = useApp();
  const { profile, record } = robot;
  const cid = robot.models[0] ?? "";
  const description = useModel(cid)?.description ?? null;
  const jobs = useData<{ liabilities: Liability[] }>(`liabilities?party=${robot.address}&limit=20`);
  useTopic("chain", jobs.reload);
  return (
    <>
      <section class="hero">
        <Picture address={robot.address} cid={profile?.picture} size="large" />
        <div>
          <h1>{nameOf(robot)}</h1>
          <p class="does"><Strange text={description?.title ?? texts.undescribed} most={80} />{profile?.place ? <span class="quiet"> · <Strange text={profile.place} most={80} /></span> : null}</p>
          <p><Strange text={profile?.about || description?.description || ""} /></p>
          <p class="inline"><Doing robot={robot} /></p>
          <p class="row">
            {cid ? <a class="button huge" href={`#/order/model/${cid}/${robot.address}`}>{texts.order}</a> : null}
            <span><strong class="price-tag">{priceOf(robot, description?.price) || texts.asksPrice}</strong> <span class="quiet">{record.done + record.failed ? texts.recordShort(record.done, record.failed) : texts.noRecord}</span></span>
          </p>
        </div>
      </section>
      <h2>{texts.readsNow}</h2>
      <Readings robot={robot.address} model={description} />
      {market.role === "operator" ? <Owner robot={robot} /> : null}
      <h2>{texts.latestJobs}</h2>
      <Show of={jobs}>{({ liabilities }) => <JobTable liabilities={liabilities} />}</Show>
      <details class="more">
        <summary>{texts.details}</summary>
        <Facts
          of={[
            [texts.address, <Name text={robot.address} label={robot.address} href={`#/account/${robot.address}`} />],
            [texts.model, cid ? <Name text={cid} label={cid} /> : ""],
            [texts.successIs, description?.success ? <Strange text={description.success} /> : ""],
            [texts.lastSeen, profile ? clock(profile.time) : ""],
          ]}
        />
        <Health agent={robot} />
      </details>
      {market.role === "operator" ? null : <OperatorLogin what={texts.yourRobot} hint={texts.operatorTokenHint} />}
    </>
  );
}

/** What the owner sees and changes: stop and release, price, pause, refused customers, income, log. */
function Owner({ robot }: { robot: Agent }) {
  const rules = useData<OwnerRules>(`agents/${robot.address}/settings`);
  return (
    <section class="panel owner">
      <h2>{texts.runIt}</h2>
      {rules.error instanceof ApiError && rules.error.code === "service-failed" && !rules.data ? <p class="callout">{texts.notFromHere}</p> : null}
      <Show of={rules.error instanceof ApiError && rules.error.code === "service-failed" ? { ...rules, error: null } : rules}>{(known) => <Controls key={JSON.stringify(known)} robot={robot} rules={known} changed={rules.reload} />}</Show>
      <Income address={robot.address} />
      <Log address={robot.address} />
    </section>
  );
}

function Controls(props: { robot: Agent; rules: OwnerRules; changed: () => void }) {
  const { robot, rules, changed } = props;
  const { notify, market } = useApp();
  const [price, setPrice] = useState(rules.price);
  const [least, setLeast] = useState(rules.leastPrice);
  const [banned, setBanned] = useState("");
  const [stopping, setStopping] = useState(false);
  const path = `agents/${robot.address}`;
  const change = (fields: Partial<OwnerRules>) => async () => {
    await post(`${path}/settings`, fields);
    notify(texts.saved);
    changed();
  };
  const stop = async () => {
    await post(`${path}/stop`, { why: texts.stoppedByOwner });
    setStopping(false);
    changed();
  };
  return (
    <>
      <div class="row">
        {rules.held ? (
          <Action id="release" class="button" run={async () => { await post(`${path}/release`, {}); changed(); }}>{texts.release}</Action>
        ) : <button type="button" id="stop-robot" class="button danger" onClick={() => setStopping(true)}>{texts.stopRobot}</button>}
        <Action id="pause" class="button quietly" run={change({ paused: !rules.paused })}>{rules.paused ? texts.takeJobs : texts.pauseJobs}</Action>
        <span class="hint">{rules.held ? texts.isHeld : rules.paused ? texts.isPaused : texts.isOpen}</span>
      </div>
      <Dialog title={texts.stopRobot} open={stopping} onClose={() => setStopping(false)}>
        <p>{texts.stopRobotHint}</p>
        <p class="row">
          <Action id="stop-now" class="button danger" run={stop}>{texts.stopNow}</Action>
          <button type="button" class="button quietly" onClick={() => setStopping(false)}>{texts.notNow}</button>
        </p>
      </Dialog>
      <div class="fields owner-fields">
        <form class="row end" onSubmit={(event) => event.preventDefault()}>
          <NumberField label={texts.priceOfJob} text={price} change={setPrice} hint={texts.priceOfJobHint(plain(market.token.symbol, 12))} />
          <Action id="set-price" class="button small" disabled={price === rules.price} run={change({ price: withUnit(price, market.token) })}>{texts.save}</Action>
        </form>
        <form class="row end" onSubmit={(event) => event.preventDefault()}>
          <NumberField label={texts.leastPrice} text={least} change={setLeast} hint={texts.leastPriceHint} />
          <Action id="set-least" class="button small" disabled={least === rules.leastPrice} run={change({ leastPrice: withUnit(least, market.token) })}>{texts.save}</Action>
        </form>
      </div>
      <h3>{texts.refused}</h3>
      <ul class="plain">
        {rules.refuse.map((address) => (
          <li key={address} class="row"><Name text={address} href={`#/account/${address}`} /><Action class="button small quietly" run={change({ refuse: rules.refuse.filter((one) => one !== address) })}>{texts.allowAgain}</Action></li>
        ))}
      </ul>
      <form class="row end" onSubmit={(event) => event.preventDefault()}>
        <Field label={texts.refuseCustomer} error={banned && !isAddress(banned) ? texts.notAnAccount : ""}>
          {(id, described) => <input id={id} aria-describedby={described} class="wide" spellcheck={false} value={banned} placeholder="0x…" onInput={(event) => setBanned(event.currentTarget.value.trim())} />}
        </Field>
        <Action class="button small quietly" disabled={!isAddress(banned)} run={change({ refuse: [...rules.refuse, banned as Address] })}>{texts.refuse}</Action>
      </form>
    </>
  );
}

/** A price with its unit: people write `5` and mean the market's token. */
function withUnit(text: string, token: Token): string {
  const trimmed = text.trim();
  return /^[\d.,]+$/.test(trimmed) ? `${trimmed} ${token.symbol}` : trimmed;
}

/** Income per week as bars, its sum, and the statement as a file. */
function Income({ address }: { address: Address }) {
  const { market } = useApp();
  const statement = useData<{ contracts: Entry[] }>(`accounts/${address}/statement`);
  useEffect(() => {
    const timer = setInterval(statement.reload, 15_000);
    return () => clearInterval(timer);
  }, []);
  return (
    <>
      <div class="row between">
        <h3>{texts.income}</h3>
        <a class="button small quietly" id="statement" href={`/api/v1/accounts/${address}/statement?format=csv`} download={`statement-${address}.csv`}>{texts.statementFile}</a>
      </div>
      <Show of={statement}>{({ contracts }) => <Weeks entries={contracts.filter((one) => one.promisor === address && one.token === market.token.address)} token={market.token} />}</Show>
    </>
  );
}

const WEEK = 7 * 86_400_000;
const WEEKS = 12;

function Weeks({ entries, token }: { entries: Entry[]; token: Token }) {
  const now = new Date();
  const monday = Date.UTC(now.getUTCFullYear(), now.getUTCMonth(), now.getUTCDate() - ((now.getUTCDay() + 6) % 7));
  const sums = new Array<bigint>(WEEKS).fill(0n);
  for (const one of entries) {
    const back = Math.floor((monday + WEEK - 1 - Date.parse(one.time)) / WEEK);
    if (back >= 0 && back < WEEKS) sums[WEEKS - 1 - back] += BigInt(one.earned);
  }
  const most = sums.reduce((one, other) => (other > one ? other : one), 0n);
  const total = sums.reduce((one, other) => one + other, 0n);
  const height = (sum: bigint) => (most ? Number((sum * 1000n) / most) / 10 : 0);
  return (
    <>
      <p class="lead">{amount(total, token)} <span class="quiet">{texts.inWeeks(WEEKS)}</span></p>
      <svg class="bars" viewBox="0 0 360 110" role="img" aria-label={texts.incomeChart(amount(total, token))}>
        {sums.map((sum, week) => (
          <g key={week}>
            <rect x={week * 30 + 4} y={100 - Math.max(height(sum), 1)} width="22" height={Math.max(height(sum), 1)} rx="3" class={sum ? "full" : "none"}>
              <title>{texts.weekOf(new Date(monday - (WEEKS - 1 - week) * WEEK).toLocaleDateString(), amount(sum, token))}</title>
            </rect>
          </g>
        ))}
      </svg>
    </>
  );
}
