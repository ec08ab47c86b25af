import { useState } from "preact/hooks";
import { post } from "../api";
import { useApp, useData, useTopic } from "../app";
import { amount, duration, size } from "../format";
import { texts } from "../texts";
import type { Agent, Liability } from "../types";
import { Action, Badge, Facts, Field, Money, Name, Show, Strange, Table } from "../ui";
import { JobTable } from "./account";

/** Who is present, for owners and operators: health, jobs by phase, earnings, alerts, actions. */
export function RobotsPage() {
  const agents = useData<{ agents: Agent[]; unlisted: number }>("agents");
  const [live, setLive] = useState<Agent[] | null>(null);
  useTopic("agents", (event) => event.kind === "agents" ? setLive(event.data.agents) : agents.reload());
  return (
    <>
      <h1>{texts.robotsTitle}</h1>
      <Show of={agents}>{({ agents: known, unlisted }) => <AgentList agents={live ?? known} unlisted={unlisted} />}</Show>
    </>
  );
}

function AgentList(props: { agents: Agent[]; unlisted: number }) {
  const { market } = useApp();
  const [open, setOpen] = useState("");
  const alerts = props.agents.filter((agent) => agent.health !== "alive");
  const chosen = props.agents.find((agent) => agent.address + agent.role === open);
  return (
    <>
      {alerts.map((agent) => (
        <p class="callout warn" key={agent.address + agent.role}>
          {texts.health[agent.health]}: <Strange text={agent.role} most={40} /> <Name text={agent.address} /> <Strange text={troubles(agent)} />
        </p>
      ))}
      <Table label={texts.robotsTitle} head={[texts.healthTitle, texts.role, texts.account, texts.jobs, texts.record, texts.earned, texts.uptime, ""]} numbers={[5, 6]} empty={texts.nobodyPresent}>
        {props.agents.map((agent) => (
          <tr key={agent.address + agent.role} class={agent === chosen ? "chosen" : ""}>
            <td><span class={`dot ${agent.health === "alive" ? "good" : agent.health === "degraded" ? "warn" : "bad"}`} aria-hidden="true" /> {texts.health[agent.health]}</td>
            <td><Strange text={agent.role} most={40} /></td>
            <td><Name text={agent.address} href={`#/account/${agent.address}`} /></td>
            <td><Phases jobs={agent.status?.work?.jobs} /></td>
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

function troubles(agent: Agent): string {
  const parts = Object.entries(agent.status?.parts ?? {}).filter(([, state]) => state !== "alive" && state !== "off");
  return parts.map(([part, state]) => `${part}: ${state}`).join(", ");
}

function Phases(props: { jobs?: Record<string, number> }) {
  const busy = Object.entries(props.jobs ?? {}).filter(([, count]) => count > 0);
  return <span class="inline">{busy.map(([phase, count]) => <Badge key={phase} kind="calm">{texts.phase[phase] ?? phase} {count}</Badge>)}</span>;
}

function AgentDetails({ agent }: { agent: Agent }) {
  const { market } = useApp();
  const { status } = agent;
  const jobs = useData<{ liabilities: Liability[] }>(`liabilities?party=${agent.address}&limit=20`);
  useTopic("chain", jobs.reload);
  return (
    <section class="panel">
      <h2><Strange text={agent.role} most={40} /> <Name text={agent.address} /></h2>
      <div class="columns">
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
              ...Object.entries(status?.dropped ?? {}).map(([reason, count]) => [texts.dropped(reason), count] as [string, number]),
            ]}
          />
        </div>
      </div>
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
      <Show of={jobs}>{({ liabilities }) => <JobTable liabilities={liabilities} />}</Show>
      {market.role === "operator" ? <Operate agent={agent} /> : <p class="hint">{texts.operatorsOnly}</p>}
    </section>
  );
}

function Operate({ agent }: { agent: Agent }) {
  const { notify } = useApp();
  const [job, setJob] = useState("");
  const act = (action: string) => async () => {
    await post(`agents/${agent.address}/${action}`, { liability: job });
    notify(texts.sent(action));
  };
  return (
    <div class="row end">
      <Field label={texts.jobAddress}>
        {(id) => <input id={id} class="wide" spellcheck={false} value={job} onInput={(event) => setJob(event.currentTarget.value.trim())} />}
      </Field>
      {["start", "finish", "restart"].map((action) => <Action key={action} class="button small" disabled={!job} run={act(action)}>{texts.action[action]}</Action>)}
    </div>
  );
}
