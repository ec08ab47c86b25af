import { useState } from "preact/hooks";
import type { Address } from "viem";
import { post, query } from "../api";
import { useApp, useData, useEvery } from "../app";
import { amount, clock, duration, ether, size } from "../format";
import { texts } from "../texts";
import type { AccountState, Agent, Agents, LogEvent } from "../types";
import { Action, Badge, Facts, Field, Money, Name, Show, Strange, Table, WordField } from "../ui";
import { LatestJobs } from "./account";
import { LoginForm } from "./login";

/** Who is present, for operators: health, jobs by phase, earnings, alerts, actions. */
export function Services() {
  const { agents } = useApp();
  return agents ? <AgentList {...agents} /> : <p class="quiet" aria-busy="true">{texts.loading}</p>;
}

function AgentList(props: Agents) {
  const { market } = useApp();
  const [open, setOpen] = useState("");
  const chosen = props.agents.find((agent) => agent.address + agent.role === open);
  return (
    <>
      {props.alerts.map((alert) => (
        <p class="callout warn" key={alert.agent + alert.code + alert.detail}>
          <strong>{texts.alert[alert.code] ?? alert.code}</strong> <Name text={alert.agent} /> <Strange text={alert.detail} />
        </p>
      ))}
      <Table label={texts.robotsTitle} head={[texts.healthTitle, texts.role, texts.account, texts.jobs, texts.record, texts.earned, texts.uptime, ""]} numbers={[5, 6]} empty={texts.nobodyPresent}>
        {props.agents.map((agent) => (
          <tr key={agent.address + agent.role} class={agent === chosen ? "chosen" : ""}>
            <td><span class={`dot ${agent.health === "alive" ? "good" : agent.health === "degraded" ? "warn" : "bad"}`} aria-hidden="true" /> {texts.health[agent.health]}</td>
            <td data-role={agent.role}><Strange text={agent.role} most={40} /></td>
            <td><Name text={agent.address} href={`#/account/${agent.address}`} /></td>
            <td><Phases jobs={agent.status?.work?.jobs ?? agent.status?.validation?.cases} /></td>
            <td>{texts.recordShort(agent.record.done, agent.record.failed)}</td>
            <td class="right"><Money units={agent.record.earned} token={market.token} /></td>
            <td class="right">{agent.status?.uptime ? duration(agent.status.uptime) : ""}</td>
            <td>
              <button type="button" class="button small quietly" aria-expanded={agent === chosen} onClick={() => setOpen(agent === chosen ? "" : agent.address + agent.role)}>{texts.details}</button>
            </td>
          </tr>
        ))}
      </Table>
      {props.unlisted ? <p class="hint">{texts.unlisted(props.unlisted)}</p> : null}
      {chosen ? <AgentDetails key={open} agent={chosen} /> : null}
    </>
  );
}

function Phases(props: { jobs?: Record<string, number> }) {
  const busy = Object.entries(props.jobs ?? {}).filter(([, count]) => count > 0);
  return <span class="inline">{busy.map(([phase, count]) => <Badge key={phase} kind="calm">{texts.phase[phase] ?? phase} {count}</Badge>)}</span>;
}

function AgentDetails({ agent }: { agent: Agent }) {
  const { market } = useApp();
  return (
    <section class="panel">
      <h2><Strange text={agent.role} most={40} /> <Name text={agent.address} href={agent.role === "agent" ? `#/robot/${agent.address}` : undefined} /></h2>
      <Health agent={agent} />
      {agent.offers.length ? (
        <>
          <h3>{texts.offers}</h3>
          <Table label={texts.offers} head={[texts.offer, texts.price, texts.model, texts.objective]} numbers={[1]}>
            {agent.offers.map((offer) => (
              <tr key={offer.hash}>
                <td><Name text={offer.hash} href={`#/order/${offer.hash}`} /></td>
                <td class="right">{amount(offer.cost, market.token)}</td>
                <td><Name text={offer.model} href={`#/order/model/${offer.model}`} /></td>
                <td><Name text={offer.objective} href={`#/file/${offer.objective}`} /></td>
              </tr>
            ))}
          </Table>
        </>
      ) : null}
      <h3>{texts.jobs}</h3>
      <LatestJobs of={agent.address} />
      <Log address={agent.address} />
      {market.role === "operator" ? <OperateByAddress robot={agent.address} /> : <OperatorLogin what={texts.operatorsOnly} />}
    </section>
  );
}

/** The parts, numbers and money of an agent. */
export function Health({ agent }: { agent: Agent }) {
  const { market } = useApp();
  const { status } = agent;
  const account = useData<AccountState>(`accounts/${agent.address}`, "chain");
  return (
    <div class="columns three">
      <div>
        <h3>{texts.parts}</h3>
        <Facts of={Object.entries(status?.parts ?? {}).map(([part, state]) => [part, <Badge kind={state === "alive" ? "good" : state === "off" ? "calm" : "warn"}><Strange text={state} /></Badge>])} />
      </div>
      <div>
        <h3>{texts.numbers}</h3>
        <Facts
          of={[
            [texts.version, status?.version ? <Strange text={status.version} most={40} /> : ""],
            [texts.lastBlock, status?.head ?? ""],
            [texts.outbox, status?.work?.outbox ?? ""],
            [texts.store, status?.work ? texts.filesOf(status.work.store.files, size(status.work.store.bytes)) : ""],
            [texts.bookOrders, status?.market?.openOrders ?? ""],
            [texts.contractsMade, status?.market ? `${status.market.created} / ${status.market.finalized}` : ""],
            [texts.judgesFor, status?.validation ? <span class="inline">{status.validation.validators.slice(0, 4).map((one) => <Name key={one} text={one} />)}</span> : ""],
            [texts.judgesBy, status?.validation ? <Strange text={status.validation.policies.join(", ")} /> : ""],
            [texts.itsFee, status?.validation ? amount(BigInt(status.validation.fee), market.xrt) : ""],
            ...Object.entries(status?.dropped ?? {}).map(([reason, count]) => [texts.dropped(reason), count] as [string, number]),
          ]}
        />
      </div>
      <div>
        <h3>{texts.money}</h3>
        <Show of={account}>
          {({ record, spent, token, eth }) => (
            <Facts
              of={[
                [texts.earned, <Money units={record.earned} token={market.token} />],
                [texts.spent, <Money units={spent} token={market.token} />],
                [texts.balance, <Money units={token.balance} token={market.token} />],
                [texts.gas, ether(eth)],
                [texts.gasSpent, status?.market ? ether(status.market.spent) : ""],
                [texts.feesAndMinted, status?.market ? `${amount(status.market.fees, market.xrt)} + ${amount(status.market.minted, market.xrt)}` : ""],
              ]}
            />
          )}
        </Show>
      </div>
    </div>
  );
}

const LEVELS = ["debug", "info", "warning", "error"];

/** The latest events of a log, newest first; read again while they are shown. */
export function Log(props: { address: Address }) {
  const [open, setOpen] = useState(false);
  const [level, setLevel] = useState("info");
  const log = useData<{ events: LogEvent[]; answered: boolean }>(open ? `agents/${props.address}/logs${query({ level, lines: 200 })}` : null);
  useEvery(3_000, log.reload, open);
  return (
    <details class="more" id="log" open={open} onToggle={(event) => setOpen(event.currentTarget.open)}>
      <summary>{texts.log}</summary>
      <Field label={texts.level}>
        {(id) => (
          <select id={id} value={level} onChange={(event) => setLevel(event.currentTarget.value)}>
            {LEVELS.map((one) => <option key={one} value={one}>{one}</option>)}
          </select>
        )}
      </Field>
      <Show of={log}>
        {({ events, answered }) => (
          <Table label={texts.log} head={[texts.time, texts.level, texts.what, texts.message]} empty={answered ? texts.noEvents : texts.noLog}>
            {[...events].reverse().map((event) => (
              <tr key={`${event.time}${event.sequence}`}>
                <td class="number">{clock(Date.parse(event.time) / 1000)}</td>
                <td><Badge kind={event.level === "error" || event.level === "critical" ? "bad" : event.level === "warning" ? "warn" : "calm"}>{event.level}</Badge></td>
                <td><code><Strange text={event.event ?? ""} most={60} /></code></td>
                <td><Strange text={event.message} /> {event.liability ? <Name text={event.liability} href={`#/job/${event.liability}`} /> : null}</td>
              </tr>
            ))}
          </Table>
        )}
      </Show>
    </details>
  );
}

/** Buttons that start, finish or restart a job; only for operators. */
export function Operate(props: { robot: Address; job: string }) {
  const { market, notify } = useApp();
  if (market.role !== "operator") return null;
  const act = (action: string) => async () => {
    const { success, msg } = await post<{ success?: boolean; msg?: string }>(`agents/${props.robot}/${action}`, { liability: props.job });
    if (success === false) notify(texts.notDone(action, msg ?? ""), "bad");
    else notify(texts.sent(action));
  };
  return (
    <p class="row operate">
      {["start", "finish", "restart"].map((action) => (
        <Action key={action} id={action} class="button small quietly" disabled={!props.job} run={act(action)}>{texts.action[action]}</Action>
      ))}
    </p>
  );
}

function OperateByAddress(props: { robot: Address }) {
  const [job, setJob] = useState("");
  return (
    <div class="row end">
      <WordField label={texts.jobAddress} text={job} change={setJob} />
      <Operate robot={props.robot} job={job} />
    </div>
  );
}

/** A login for operators, below words that say what for. */
export function OperatorLogin(props: { what: string; hint?: string }) {
  const { reloadMarket } = useApp();
  return (
    <details class="more">
      <summary>{props.what}</summary>
      <LoginForm label={texts.operatorToken} hint={props.hint} done={reloadMarket} />
    </details>
  );
}
