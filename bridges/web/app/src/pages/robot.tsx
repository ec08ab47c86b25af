import { useState } from "preact/hooks";
import { isAddress } from "viem";
import type { Address } from "viem";
import { ApiError, post } from "../api";
import { useApp, useData, useEvery, useModel, useTyped } from "../app";
import { amount, clock, ether, plain, since } from "../format";
import { Readings } from "../live";
import { texts } from "../texts";
import type { Agent, Entry, OwnerRules, RobotEvent, Token } from "../types";
import { Action, Badge, Facts, Name, NumberField, Picture, Show, StopDialog, Strange, WordField } from "../ui";
import { LatestJobs } from "./account";
import { Doing, Title, nameOf, priceOf, recordOf } from "./robots";
import { Health, Log, OperatorLogin } from "./services";

/** One robot: who it is, what it reads, what it did; and for its owner, how it is run. */
export function RobotPage(props: { address: string }) {
  const { agents, robotAt } = useApp();
  const robot = robotAt(props.address);
  if (!robot && agents === null) return <p class="quiet" aria-busy="true">{texts.loading}</p>;
  return <RobotView robot={robot ?? unknown(props.address as Address)} />;
}

/** A robot of which nobody has heard lately. */
function unknown(address: Address): Agent {
  const record = { created: 0, done: 0, failed: 0, open: 0, earned: "0" };
  return { role: "agent", address, health: "away", status: null, models: [], offers: [], record, profile: null };
}

function RobotView({ robot }: { robot: Agent }) {
  const { market } = useApp();
  const { profile, record } = robot;
  const cid = robot.models[0] ?? "";
  const description = useModel(cid)?.description ?? null;
  const isAway = robot.health === "away";
  return (
    <>
      <section class="hero">
        <Picture address={robot.address} cid={profile?.picture} size="large" />
        <div>
          <h1>{nameOf(robot)}</h1>
          <p class="does"><Title of={description} />{profile?.place ? <span class="quiet"> · <Strange text={profile.place} most={80} /></span> : null}</p>
          <p><Strange text={profile?.about || description?.description || ""} /></p>
          <p class="inline"><Doing robot={robot} /></p>
          <p class="row">
            {isAway ? <a class="button quietly" href="#/">{texts.otherRobots}</a> : cid ? <a class="button huge" href={`#/order/model/${cid}/${robot.address}`}>{texts.order}</a> : null}
            <span>{isAway ? null : <strong class="price-tag">{priceOf(robot, description?.price) || texts.asksPrice}</strong>} <span class="quiet">{recordOf(record)}</span></span>
          </p>
        </div>
      </section>
      <h2>{isAway ? texts.readLast : texts.readsNow}</h2>
      <Readings robot={robot.address} model={description} />
      {market.role === "operator" ? <Owner robot={robot} /> : null}
      <h2>{texts.latestJobs}</h2>
      <LatestJobs of={robot.address} />
      <details class="more">
        <summary>{texts.details}</summary>
        <Facts
          of={[
            [texts.address, <Name text={robot.address} label={robot.address} href={`#/account/${robot.address}`} />],
            [texts.formerly, profile?.formerly?.map((before) => <Name text={before} label={before} href={`#/account/${before}`} />)],
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

/** What the owner sees and changes: stop and release, price, pause, refused customers, notifications, income, log. */
function Owner({ robot }: { robot: Agent }) {
  const isAway = robot.health === "away";
  const rules = useData<OwnerRules>(isAway ? null : `agents/${robot.address}/settings`);
  useEvery(3_000, rules.reload, !isAway);
  const isClosed = rules.error instanceof ApiError && rules.error.code === "service-failed";
  return (
    <section class="panel owner">
      <h2>{texts.forOwner}</h2>
      {isClosed && !rules.data ? <p class="callout">{texts.notFromHere}</p> : null}
      <Show of={isClosed ? { ...rules, error: null } : rules}>
        {({ notify, events, ...known }) => (
          <>
            <Controls key={JSON.stringify(known)} robot={robot} rules={known} changed={rules.reload} />
            <Notifications notify={notify} events={events} />
          </>
        )}
      </Show>
      <Income address={robot.address} />
      {isAway ? null : <Log address={robot.address} />}
    </section>
  );
}

/** The latest of what the owner is told, and who tells him. */
function Notifications({ notify, events }: Pick<OwnerRules, "notify" | "events">) {
  const targets = notify.map(({ target, waiting }) => (waiting ? texts.stillWaiting(target, waiting) : target)).join(", ");
  return (
    <>
      <h3>{texts.notifications}</h3>
      {events.length ? (
        <ol class="plain events" aria-label={texts.notifications} tabIndex={0}>
          {[...events].reverse().map((one) => <Happened key={`${one.time}${one.event}${one.about}`} event={one} />)}
        </ol>
      ) : <p class="quiet">{texts.nothingHappened}</p>}
      {targets ? <p class="hint"><Strange text={texts.notified(targets)} /></p> : (
        <>
          <p class="hint">{texts.nobodyNotified}</p>
          <pre>{texts.notifyExample}</pre>
        </>
      )}
    </>
  );
}

const KINDS: Record<string, "good" | "bad" | "warn"> = { "job-paid": "good", "job-failed": "bad", "robot-unreachable": "warn", "low-on-gas": "warn" };

function Happened({ event: { event, time, about, detail } }: { event: RobotEvent }) {
  return (
    <li>
      <span class="number quiet">{since(time)}</span>
      <span>
        <Badge kind={KINDS[event] ?? "calm"}>{texts.robotEvent[event] ?? event}</Badge>{" "}
        <Strange text={event === "low-on-gas" && /^\d+$/.test(detail) ? ether(detail) : detail} />{" "}
        {isAddress(about) ? <a href={`#/job/${about}`}>{texts.showJob}</a> : null}
      </span>
    </li>
  );
}

type Rules = Omit<OwnerRules, "notify" | "events">;

function Controls(props: { robot: Agent; rules: Rules; changed: () => void }) {
  const { robot, rules, changed } = props;
  const { notify, market } = useApp();
  const [banned, setBanned, forgetBanned] = useTyped(`refuse ${rules.refuse}`, () => "");
  const [stopping, setStopping] = useState(false);
  const path = `agents/${robot.address}`;
  const change = (fields: Partial<Rules>, forget?: () => void) => async () => {
    await post(`${path}/settings`, fields);
    forget?.();
    notify(texts.saved);
    changed();
  };
  const stop = async () => {
    await post(`${path}/stop`, { why: texts.stoppedByOwner });
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
      <StopDialog title={texts.stopRobot} open={stopping} close={() => setStopping(false)} stop={stop} notNow={texts.notNow}><p>{texts.stopRobotHint}</p></StopDialog>
      <div class="fields owner-fields">
        <PriceSetting id="set-price" label={texts.priceOfJob} hint={texts.priceOfJobHint(plain(market.token.symbol, 32))} now={rules.price} save={(price, forget) => change({ price }, forget)()} />
        <PriceSetting id="set-least" label={texts.leastPrice} hint={texts.leastPriceHint} now={rules.leastPrice} save={(leastPrice, forget) => change({ leastPrice }, forget)()} />
      </div>
      <h3>{texts.refused}</h3>
      <ul class="plain">
        {rules.refuse.map((address) => (
          <li key={address} class="row"><Name text={address} href={`#/account/${address}`} /><Action class="button small quietly" run={change({ refuse: rules.refuse.filter((one) => one !== address) })}>{texts.allowAgain}</Action></li>
        ))}
      </ul>
      <form class="row end" onSubmit={(event) => event.preventDefault()}>
        <WordField label={texts.refuseCustomer} text={banned} change={setBanned} placeholder="0x…" error={banned && !isAddress(banned) ? texts.notAnAccount : ""} />
        <Action class="button small quietly" disabled={!isAddress(banned)} run={change({ refuse: [...rules.refuse, banned as Address] }, forgetBanned)}>{texts.refuse}</Action>
      </form>
    </>
  );
}

/** A price that may be changed: people write `5` and mean the market's token. */
function PriceSetting(props: { id: string; label: string; hint: string; now: string; save: (price: string, forget: () => void) => Promise<void> }) {
  const { market } = useApp();
  const [text, setText, forget] = useTyped(`${props.id} ${props.now}`, () => props.now);
  const price = /^[\d.,]+$/.test(text.trim()) ? `${text.trim()} ${market.token.symbol}` : text.trim();
  return (
    <form class="row end" onSubmit={(event) => event.preventDefault()}>
      <NumberField label={props.label} text={text} change={setText} hint={props.hint} />
      <Action id={props.id} class="button small" disabled={text === props.now} run={() => props.save(price, forget)}>{texts.save}</Action>
    </form>
  );
}

/** Income per week as bars, its sum, and the statement as a file. */
function Income({ address }: { address: Address }) {
  const { market } = useApp();
  const statement = useData<{ contracts: Entry[] }>(`accounts/${address}/statement`);
  useEvery(15_000, statement.reload);
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
