import { useMemo, useState } from "preact/hooks";
import { useApp, useModel } from "../app";
import { isCid } from "../cid";
import { duration, plain, short, since } from "../format";
import { texts } from "../texts";
import type { Agent, Description, JobRecord } from "../types";
import { Badge, Picture, Strange, WordField } from "../ui";

/** The robots of an owner, not the programs of people who order. */
export function robotsOf(agents: Agent[] | undefined): Agent[] {
  return (agents ?? []).filter((agent) => agent.role === "agent" && (agent.profile || agent.models.length));
}

/** Home: who is here, what each does and for how much; and who is away. */
export function RobotsPage() {
  const { agents, away, market } = useApp();
  const [search, setSearch] = useState("");
  const [model, setModel] = useState("");
  const robots = robotsOf(agents?.agents);
  const models = [...new Set([...robots, ...away].flatMap((robot) => robot.models))];
  const isWanted = (robot: Agent) => (!model || robot.models.includes(model)) && matches(robot, search);
  const shown = robots.filter(isWanted);
  const gone = away.filter(isWanted);
  const order = { idle: 0, working: 1, closed: 2, stopped: 3 };
  shown.sort((one, other) => (order[one.profile?.state ?? "stopped"] - order[other.profile?.state ?? "stopped"]) || nameOf(one).localeCompare(nameOf(other)));
  return (
    <>
      <h1>{texts.homeTitle}</h1>
      {robots.length + away.length > 1 ? (
        <div class="row find" role="search">
          <input type="search" aria-label={texts.search} placeholder={texts.search} value={search} onInput={(event) => setSearch(event.currentTarget.value)} />
          <ModelFilter models={models} model={model} choose={setModel} />
        </div>
      ) : null}
      {agents === null ? <p class="quiet" aria-busy="true">{texts.loading}</p> : null}
      <div class="robots">{shown.map((robot) => <RobotCard key={robot.address} robot={robot} />)}</div>
      {agents !== null && !robots.length && market.connected.router ? (
        <div class="empty">
          <h2>{texts.noRobotsTitle}</h2>
          <p>{texts.noRobotsHint}</p>
          <pre>{texts.noRobotsCommand}</pre>
        </div>
      ) : robots.length + away.length && !shown.length && !gone.length ? <p class="empty">{texts.noneFound} <button type="button" class="button small quietly" onClick={() => { setSearch(""); setModel(""); }}>{texts.showAll}</button></p> : null}
      {gone.length ? (
        <section>
          <h2>{texts.away}</h2>
          <ul class="rows away" aria-label={texts.away}>{gone.map((robot) => <AwayRow key={robot.address} robot={robot} />)}</ul>
        </section>
      ) : null}
      <ByModel />
    </>
  );
}

/** A robot that is away: who it was, and what it has done. */
function AwayRow({ robot }: { robot: Agent }) {
  const description = useModel(robot.models[0] ?? "")?.description;
  return (
    <li>
      <a class="list-row" href={`#/robot/${robot.address}`}>
        <Picture address={robot.address} cid={robot.profile?.picture} size="small" />
        <span class="who"><strong>{nameOf(robot)}</strong><span class="quiet"><Title of={description} /> · {recordOf(robot.record)}</span></span>
        <Doing robot={robot} />
      </a>
    </li>
  );
}

/** What a model does, in its own words. */
export function Title(props: { of: Description | null | undefined; most?: number }) {
  return <Strange text={props.of?.title || texts.undescribed} most={props.most ?? 80} />;
}

/** How many jobs a robot has done. */
export function recordOf({ done, failed }: Pick<JobRecord, "done" | "failed">): string {
  return done + failed ? texts.recordShort(done, failed) : texts.noRecord;
}

/** What a robot is called here. */
export function nameOf(robot: Agent): string {
  return plain(robot.profile?.name ?? "", 80) || `${texts.robot} ${short(robot.address)}`;
}

function matches(robot: Agent, search: string): boolean {
  const { name = "", about = "", place = "" } = robot.profile ?? {};
  const text = `${name} ${about} ${place} ${robot.address}`.toLowerCase();
  return search.toLowerCase().split(/\s+/).every((word) => text.includes(word));
}

/** Buttons that leave only what is of one model; none where there is only one. */
export function ModelFilter(props: { models: string[]; model: string; choose: (cid: string) => void }) {
  if (props.models.length < 2) return null;
  return (
    <div class="chips" role="group" aria-label={texts.byModel}>
      <button type="button" class="chip" aria-pressed={!props.model} onClick={() => props.choose("")}>{texts.all}</button>
      {props.models.map((cid) => <ModelChip key={cid} cid={cid} chosen={cid === props.model} choose={props.choose} />)}
    </div>
  );
}

function ModelChip(props: { cid: string; chosen: boolean; choose: (cid: string) => void }) {
  const model = useModel(props.cid);
  return <button type="button" class="chip" aria-pressed={props.chosen} onClick={() => props.choose(props.cid)}><Title of={model?.description} most={40} /></button>;
}

function RobotCard({ robot }: { robot: Agent }) {
  const { profile, record } = robot;
  const cid = robot.models[0] ?? "";
  const description = useModel(cid)?.description;
  const page = `#/robot/${robot.address}`;
  const price = priceOf(robot, description?.price);
  return (
    <article class="robot">
      <a class="face" href={page} tabIndex={-1} aria-hidden="true"><Picture address={robot.address} cid={profile?.picture} size="large" /></a>
      <div class="inside">
        <h2><a href={page}>{nameOf(robot)}</a></h2>
        <p class="does"><Title of={description} /></p>
        <p class="about"><Strange text={profile?.about || description?.description || ""} most={160} /></p>
        <p class="inline"><Doing robot={robot} />{profile?.place ? <Badge kind="calm"><Strange text={profile.place} most={40} /></Badge> : null}</p>
        <Readings of={profile?.readings ?? {}} />
        <div class="row between foot">
          <span><strong class="price-tag">{price || texts.asksPrice}</strong><span class="quiet record">{recordOf(record)}</span></span>
          {cid ? <a class="button" href={`#/order/model/${cid}/${robot.address}`} aria-label={texts.orderFrom(nameOf(robot))}>{texts.order}</a> : null}
        </div>
      </div>
    </article>
  );
}

/** What a job of a robot usually costs, as it says; empty if it does not. */
export function priceOf(robot: Agent, described: string | undefined): string {
  return plain(robot.profile?.price || described || "", 40);
}

/** What a robot is doing, and how long a new job would wait. */
export function Doing({ robot }: { robot: Agent }) {
  const { profile, health } = robot;
  if (health === "away") return <Badge kind="calm">{robot.since ? texts.awaySince(since(robot.since)) : texts.robotAway}</Badge>;
  if (health === "silent") return <Badge kind="warn">{texts.health.silent}</Badge>;
  if (!profile) return <Badge kind="calm">{texts.doing.present}</Badge>;
  const kinds = { idle: "good", working: "calm", stopped: "bad", closed: "warn" } as const;
  return (
    <>
      <Badge kind={kinds[profile.state]}>{texts.doing[profile.state]}</Badge>
      {profile.queue ? <Badge kind="calm">{texts.waiting(profile.queue)}</Badge> : null}
      {profile.wait ? <Badge kind="calm">{texts.beginsIn(duration(profile.wait))}</Badge> : null}
    </>
  );
}

/** The latest readings of a robot, in its own words. */
function Readings({ of }: { of: Record<string, string> }) {
  const readings = Object.entries(of);
  if (!readings.length) return null;
  return (
    <dl class="glance">
      {readings.slice(0, 4).map(([topic, text]) => <div key={topic}><dt><Strange text={words(topic)} most={30} /></dt><dd><Strange text={text} most={40} /></dd></div>)}
    </dl>
  );
}

/** A topic as people say it: `/arm/battery_level` is the battery level. */
export function words(topic: string): string {
  const last = topic.split("/").filter(Boolean).at(-1) ?? topic;
  return last.replace(/_/g, " ");
}

/** For whoever has the CID of a model that nobody here names. */
function ByModel() {
  const [cid, setCid] = useState("");
  const go = useMemo(() => (event: Event) => { event.preventDefault(); location.hash = `#/order/model/${cid}`; }, [cid]);
  return (
    <details class="more">
      <summary>{texts.otherModel}</summary>
      <form class="row end" onSubmit={go}>
        <WordField label={texts.modelCid} text={cid} change={setCid} error={cid && !isCid(cid) ? texts.notACid : ""} hint={texts.modelCidHint} />
        <button class="button" disabled={!isCid(cid)}>{texts.goOn}</button>
      </form>
    </details>
  );
}
