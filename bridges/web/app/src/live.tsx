// What robots measure and say, before one's eyes: live, and afterwards from the recording.

import { useEffect, useMemo, useRef, useState } from "preact/hooks";
import type { Address } from "viem";
import { get, getExact, query } from "./api";
import { isUnreachable, useData, useReturn, useTopic } from "./app";
import { clock, duration, plain, shown, size } from "./format";
import "./live.css";
import { Path, Plot } from "./plot";
import type { Frame } from "./plot";
import { texts } from "./texts";
import { Gathered, MOST_MESSAGES, MOST_PICTURES, MOST_STATES, MOST_TRACKS, elapsed, inOrder, latest, placeAt, statesOf, topicOf, viewOf, withoutNumbers } from "./tracks";
import type { Sample, State, Track } from "./tracks";
import type { Description, Message, Summary, TopicSummary, ValueSchema, Values } from "./types";
import { Action, Badge, Problem, Show, Strange, Table } from "./ui";
import { inWords } from "./values";

export type { Sample } from "./tracks";

/** Milliseconds between two renderings of what is live; plots are drawn in each frame. */
const REFRESH = 125;
/** Milliseconds between two times of a recording that plays. */
const REPLAY = 60;
/** Seconds that are in view while more comes. */
const WINDOW = 60;
const LINES = 40;

/** What comes while a job runs, from its beginning. */
export function LiveJob(props: { address: Address; model: Description | null }) {
  return (
    <Following path={`liabilities/${props.address}/live`} topic={`live/${props.address}`} model={props.model} empty={texts.nothingLive} clock={false}
      samplesOf={(answer: { samples: Sample[] }) => answer.samples} />
  );
}

/** What a robot measures all the time, with what it measured before. */
export function Readings(props: { robot: Address; model: Description | null }) {
  return (
    <Following path={`agents/${props.robot}/readings`} topic={`readings/${props.robot}`} model={props.model} empty={texts.nothingRead} clock
      samplesOf={(answer: { readings: Record<string, Sample[]> }) => Object.values(answer.readings).flat().sort((one, other) => one.at - other.at)} />
  );
}

function Following<T>(props: { path: string; topic: string; model: Description | null; empty: string; clock: boolean; samplesOf: (answer: T) => Sample[] }) {
  const { path, topic } = props;
  const [gathered, setGathered] = useState<Gathered | null>(null);
  const [error, setError] = useState<unknown>(null);
  const [turn, setTurn] = useState(0);
  const [whole, setWhole] = useState(props.clock);
  const [, setSeen] = useState(0);
  /** What comes while the answer is on its way. */
  const waiting = useRef<Sample[] | null>([]);
  useTopic(topic, (event) => {
    if (event.kind === "gap") setTurn((known) => known + 1);
    else if (event.kind !== "message") return;
    else if (!waiting.current) gathered?.addNew(event.data);
    else if (waiting.current.push(event.data) > 2 * MOST_MESSAGES) waiting.current.shift();
  });
  useEffect(() => {
    const stopped = new AbortController();
    waiting.current ??= [];
    setError(null);
    get<T>(path, stopped.signal).then(
      (answer) => {
        const made = gathered ?? new Gathered(!props.clock); // a server that has begun anew knows less than this page
        // What came meanwhile is in the answer, too.
        for (const sample of [...props.samplesOf(answer), ...(waiting.current ?? [])]) made.addNew(sample);
        waiting.current = null;
        setGathered(made);
      },
      (problem) => {
        if (!stopped.signal.aborted) setError(problem);
      },
    );
    return () => stopped.abort();
  }, [path, turn]);
  useEffect(() => {
    if (!gathered) return;
    const timer = setInterval(() => setSeen(gathered.count), REFRESH);
    return () => clearInterval(timer);
  }, [gathered]);
  useReturn(error, () => setTurn((known) => known + 1));
  const problem = error && !(gathered && isUnreachable(error)) ? <Problem error={error} retry={() => setTurn((known) => known + 1)} /> : null;
  if (!gathered) return problem ?? <p class="quiet" aria-busy="true">{texts.loading}</p>;
  if (!gathered.tracks.length) return <p class="empty quiet">{props.empty}</p>;
  const isLong = gathered.to - gathered.from > WINDOW;
  return (
    <>
      {problem}
      {isLong ? (
        <div class="segments" role="group" aria-label={texts.inView}>
          {[false, true].map((all) => <button key={String(all)} type="button" aria-pressed={whole === all} onClick={() => setWhole(all)}>{all ? texts.wholeTime : texts.lastMinute}</button>)}
        </div>
      ) : null}
      <Tracks gathered={gathered} model={props.model} frame={frameOf(gathered, { clock: props.clock, live: true, window: whole ? Infinity : WINDOW })} />
    </>
  );
}

/** What plots of `gathered` show: all of it, or the last `window` seconds; at first there is room for what comes. */
function frameOf(gathered: Gathered, { until, clock = false, live = false, window = Infinity }: { until?: number; clock?: boolean; live?: boolean; window?: number }): Frame {
  const from = () => Math.max(gathered.from, gathered.to - window);
  const to = () => (live ? Math.max(gathered.to, from() + 8) : gathered.to);
  return { from, to, clock, until, news: () => `${gathered.count} ${from()}` };
}

/** Panels in columns. A panel stays in its column, so that what is live never jumps; a new one goes where there is most room. */
function Tracks(props: { gathered: Gathered; model: Description | null; frame: Frame }) {
  const box = useRef<HTMLDivElement>(null);
  const [count, setCount] = useState(0);
  const placed = useRef<{ of: Map<string, number>; heights: number[] }>({ of: new Map(), heights: [] });
  useEffect(() => {
    const resized = new ResizeObserver(([{ contentRect }]) => setCount(Math.max(1, Math.floor(contentRect.width / NARROWEST))));
    resized.observe(box.current!);
    return () => resized.disconnect();
  }, []);
  if (placed.current.heights.length !== count) placed.current = { of: new Map(), heights: new Array(count).fill(0) };
  const columns: Track[][] = Array.from({ length: count }, () => []);
  const { of, heights } = placed.current;
  for (const track of count ? inOrder(props.gathered.tracks, props.model) : []) {
    const key = `${track.role} ${track.topic}`;
    let column = of.get(key);
    if (column === undefined) {
      of.set(key, (column = heights.indexOf(Math.min(...heights))));
      heights[column] += heightOf(track, props.model);
    }
    columns[column].push(track);
  }
  return (
    <div class="tracks" ref={box}>
      {columns.map((tracks, place) => (
        <div key={place}>
          {tracks.map((track) => <Panel key={`${track.role} ${track.topic}`} track={track} model={props.model} frame={props.frame} />)}
        </div>
      ))}
    </div>
  );
}

/** Pixels of a column, at least. */
const NARROWEST = 340;

/** About the height of a panel, in the heights of a plot. */
function heightOf(track: Track, model: Description | null): number {
  const { plots, position } = viewOf(track, model);
  const parts = plots.length + (position ? 1.5 : 0) + (track.pictures.length ? 1.5 : 0);
  return (parts || 1.2) + 0.4;
}

/** One topic. */
function Panel(props: { track: Track; model: Description | null; frame: Frame }) {
  const { track, model, frame } = props;
  const view = viewOf(track, model);
  const described = topicOf(model, track);
  const title = plain(view.title, 80);
  const lines = !track.columns.length && !track.pictures.length;
  const message = latest(track.messages, frame.until);
  return (
    <article class={`track ${track.role}`}>
      <header>
        <h3><bdi>{title}</bdi></h3>
        {track.role === "objective" ? <Badge kind="calm">{texts.asked}</Badge> : null}
        <code class="quiet"><Strange text={track.topic} most={60} /></code>
      </header>
      {described?.description ? <p class="hint"><Strange text={described.description} most={200} /></p> : null}
      {track.pictures.length ? <Picture track={track} title={title} frame={frame} /> : null}
      {view.position ? <Path track={track} position={view.position} label={texts.pathOf(title)} frame={frame} /> : null}
      {view.plots.map((series) => <Plot key={series.map((one) => one.name).join()} track={track} series={series} title={title} frame={frame} />)}
      {lines ? <Lines track={track} schema={described?.value ?? {}} frame={frame} /> : <Words value={message?.value} schema={described?.value ?? {}} name={title} />}
      <p class="foot">{texts.messageCount(track.count)}</p>
    </article>
  );
}

function Picture(props: { track: Track; title: string; frame: Frame }) {
  const { until } = props.frame;
  const picture = latest(props.track.pictures, until) ?? props.track.pictures[0];
  const time = props.frame.clock ? clock(picture.at) : elapsed(picture.at);
  return (
    <figure class="picture">
      <img src={picture.image} alt={texts.imageAt(props.title, time)} />
      <figcaption class="figure">{time}</figcaption>
    </figure>
  );
}

/** The words that stand beside numbers in a message. */
function Words(props: { value: unknown; schema: ValueSchema; name: string }) {
  const words = withoutNumbers(props.value);
  if (typeof props.value === "string" || words === undefined) return null;
  return (
    <dl class="words">
      {inWords(props.schema, words, props.name).slice(0, 8).map(([name, text]) => (
        <div key={name}><dt><Strange text={name} most={40} /></dt><dd><Strange text={text} most={120} /></dd></div>
      ))}
    </dl>
  );
}

/** What was said, the newest at the top; what was said again stands once, with how often. */
function Lines(props: { track: Track; schema: ValueSchema; frame: Frame }) {
  const { track, frame } = props;
  const until = frame.until === undefined ? track.messages.length - 1 : placeAt(track.messages.map((one) => one.at), frame.until);
  const lines: { key: number; at: number; text: string; times: number }[] = [];
  for (let place = until; place >= 0 && lines.length < LINES; place--) {
    const message = track.messages[place];
    const text = lineOf(message, props.schema);
    const last = lines.at(-1);
    if (last?.text === text) Object.assign(last, { at: message.at, times: last.times + 1 });
    else lines.push({ key: message.at, at: message.at, text, times: 1 });
  }
  const said = track.messages.slice(-MOST_STATES * 4).map((message) => ({ at: message.at, text: lineOf(message, props.schema) }));
  return (
    <>
    <States states={statesOf(said, frame.to())} frame={frame} />
    <ol class="lines" tabIndex={0} aria-label={texts.messagesOf(plain(track.topic, 60))}>
      {lines.map((line) => (
        <li key={line.key}>
          <time class="figure">{frame.clock ? clock(line.at) : elapsed(line.at)}</time>
          <span><bdi class="strange">{line.text}</bdi>{line.times > 1 ? <span class="quiet"> ×{line.times}</span> : null}</span>
        </li>
      ))}
    </ol>
    </>
  );
}

/** Over time, which of a few words held: what a lamp, a door or a mode was. */
function States(props: { states: State[]; frame: Frame }) {
  const { states, frame } = props;
  if (states.length < 2) return null;
  const from = Math.max(frame.from(), states[0].from);
  const whole = frame.to() - frame.from();
  const words = [...new Set(states.map((state) => state.text))].sort();
  const share = (seconds: number) => `${Math.max(0, (100 * seconds) / whole)}%`;
  const until = frame.until === undefined ? 0 : frame.to() - frame.until;
  return (
    <div class="states" aria-hidden="true">
      {states.filter((state) => state.to > from).map((state) => {
        const begins = Math.max(from, state.from);
        const color = `var(--line-${(words.indexOf(state.text) % 8) + 1})`;
        return (
          <span key={state.from} title={state.text} style={{ left: share(begins - frame.from()), width: share(state.to - begins), background: `color-mix(in srgb, ${color} 26%, var(--panel))`, borderColor: color }}>
            {(state.to - begins) / whole > (state.text.length + 2) / 42 ? state.text : ""}
          </span>
        );
      })}
      {until > 0 ? <i class="veil" style={{ width: share(until) }} /> : null}
    </div>
  );
}

function lineOf(message: Track["messages"][number], schema: ValueSchema): string {
  const { value } = message;
  if (value === null || value === undefined) return message.size ? texts.bytes(size(message.size)) : "—";
  if (typeof value !== "object") return plain(String(value), 300) + (message.cut ? " …" : "");
  const rows = inWords(schema, value, "").slice(0, 12);
  return plain(rows.map(([name, words]) => (rows.length > 1 && name ? `${name}: ${words}` : words)).join(" · "), 300);
}

/** A recording, in the view in which it was live, with a bar to move in its time. */
export function Replay(props: { cid: string; model: Description | null }) {
  const summary = useData<Summary>(`files/${props.cid}/summary`);
  const address = `/api/v1/files/${props.cid}/recording.${summary.data?.format === "bag" ? "bag" : "mcap"}`;
  return (
    <div class="replay">
      <Show of={summary}>
        {(known) => (
          <>
            <Player cid={props.cid} summary={known} model={props.model} />
            <p class="row">
              <a class="button small quietly" href={address} download={`${props.cid}.${address.split(".").pop()}`}>{texts.download}</a>
              <a class="button small quietly" href={`foxglove://open?ds=remote-file&ds.url=${encodeURIComponent(location.origin + address)}`}>{texts.foxglove}</a>
              <span class="quiet">{[texts.messageCount(known.messages), duration(Number(known.durationNs) / 1e9), size(known.size), Number(known.startNs) > 1e15 ? clock(Number(known.startNs) / 1e9) : ""].filter(Boolean).join(" · ")}</span>
            </p>
            {known.topics.length ? (
              <details class="more">
                <summary>{texts.allMessages}</summary>
                {known.topics.map((topic) => <TopicMessages key={`${topic.role}${topic.topic}`} cid={props.cid} topic={topic} />)}
              </details>
            ) : null}
          </>
        )}
      </Show>
    </div>
  );
}

const SPEEDS = [0.25, 0.5, 1, 2, 5, 10];

function Player(props: { cid: string; summary: Summary; model: Description | null }) {
  const { summary } = props;
  const { gathered, error } = useRecorded(props.cid, summary);
  const [at, setAt] = useState<number | null>(null);
  const [playing, setPlaying] = useState(false);
  const [speed, setSpeed] = useState(1);
  const end = Number(summary.durationNs) / 1e9;
  const now = at ?? end;

  useEffect(() => {
    if (!playing) return;
    const calm = matchMedia("(prefers-reduced-motion: reduce)").matches;
    let last = performance.now();
    let next = 0;
    const step = (time: number) => {
      next = requestAnimationFrame(step);
      if (time - last < (calm ? 500 : REPLAY)) return;
      const passed = (Math.max(0, time - last) / 1000) * speed;
      last = time;
      setAt((known) => Math.min(end, (known ?? end) + passed));
    };
    next = requestAnimationFrame(step);
    return () => cancelAnimationFrame(next);
  }, [playing, speed, end]);
  useEffect(() => {
    if (playing && now >= end) setPlaying(false);
  }, [playing, now >= end]);

  const toggle = () => {
    if (!playing && now >= end) setAt(0);
    setPlaying(!playing);
  };
  const seek = (to: number) => setAt(Math.min(end, Math.max(0, to)));
  const press = (event: KeyboardEvent) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const jump = { ArrowLeft: -1, ArrowDown: -1, ArrowRight: 1, ArrowUp: 1, PageDown: -10, PageUp: 10 }[event.key];
    if (jump) seek(now + (jump * end) / 100);
    else if (event.key === " ") toggle();
    else return;
    event.preventDefault();
  };
  if (error) return <Problem error={error} />;
  if (!gathered) return <p class="quiet" aria-busy="true">{texts.loading}</p>;
  if (!gathered.tracks.length) return <p class="quiet">{texts.nothingRecorded}</p>;
  const left = summary.topics.filter((topic) => topic.messages).length - gathered.tracks.length;
  return (
    <>
      {end > 0 ? (
        <div class="player">
          <button type="button" class="button play" aria-label={playing ? texts.pause : now >= end ? texts.playAgain : texts.play} title={texts.replayKeys} onClick={toggle}>
            <svg viewBox="0 0 24 24" width="22" height="22" aria-hidden="true" fill="currentColor">
              {playing ? <path d="M6 5h4v14H6zM14 5h4v14h-4z" /> : <path d="M7 4.500v15l13-7.500z" />}
            </svg>
          </button>
          <div class="bar">
            <Activity gathered={gathered} end={end} now={now} />
            <input type="range" min={0} max={end} step="any" value={now} aria-label={texts.position} aria-valuetext={texts.positionOf(elapsed(now), elapsed(end))} title={texts.replayKeys}
              onInput={(event) => seek(Number(event.currentTarget.value))} onKeyDown={press} />
          </div>
          <span class="figure">{elapsed(now)} <span class="quiet">/ {elapsed(end)}</span></span>
          <select aria-label={texts.speed} value={speed} onChange={(event) => setSpeed(Number(event.currentTarget.value))}>
            {SPEEDS.map((one) => <option key={one} value={one}>{one}×</option>)}
          </select>
        </div>
      ) : null}
      <Tracks gathered={gathered} model={props.model} frame={{ ...frameOf(gathered, { until: at ?? undefined }), from: () => 0, to: () => Math.max(end, 1e-3), seek }} />
      {left > 0 ? <p class="hint">{texts.moreTopics(left)}</p> : null}
    </>
  );
}

const BARS = 120;

/** How much came when, behind the time bar. */
function Activity(props: { gathered: Gathered; end: number; now: number }) {
  const path = useMemo(() => {
    const counts = new Array<number>(BARS).fill(0);
    for (const track of props.gathered.tracks) {
      const times = track.at.length ? track.at : track.messages.map((one) => one.at);
      for (const at of times) counts[Math.min(BARS - 1, Math.max(0, Math.floor((at / props.end) * BARS)))] += track.count / times.length;
    }
    const most = Math.max(...counts);
    return counts.map((count, place) => (count ? `M${place} 1h.7v-${(0.15 + 0.85 * (count / most)).toFixed(3)}h-.7z` : "")).join("");
  }, [props.gathered.count, props.end]);
  return (
    <div class="activity" aria-hidden="true">
      <svg viewBox={`0 0 ${BARS} 1`} preserveAspectRatio="none"><path d={path} /></svg>
      <i class="veil" style={{ left: `${(100 * props.now) / props.end}%` }} />
    </div>
  );
}

/** The tracks of a recording: all of what is short, and evenly taken numbers of what is long. */
function useRecorded(cid: string, summary: Summary): { gathered: Gathered | null; error: unknown } {
  const [state, setState] = useState<{ gathered: Gathered | null; error: unknown }>({ gathered: null, error: null });
  useEffect(() => {
    const stopped = new AbortController();
    (async () => {
      const made = new Gathered();
      const topics = summary.topics.filter((topic) => topic.messages).slice(0, MOST_TRACKS);
      await Promise.all(topics.map((topic) => addTopic(made, cid, topic, topics, stopped.signal)));
      setState({ gathered: made, error: null });
    })().catch((error) => {
      if (!stopped.signal.aborted) setState({ gathered: null, error });
    });
    return () => stopped.abort();
  }, [cid]);
  return state;
}

async function addTopic(made: Gathered, cid: string, { topic, role, messages, shown: how }: TopicSummary, all: TopicSummary[], signal: AbortSignal): Promise<void> {
  made.complete(topic, role, messages, [], []); // its place, whichever answer comes first
  const most = how === "image" ? MOST_PICTURES : MOST_MESSAGES;
  const found: Message[] = [];
  let next: number | null = messages > most && how === "values" ? null : -1;
  for (let taken = 0; next !== null && taken < most; taken += MOST_MESSAGES) {
    const page: Page = await getExact<Page>(`files/${cid}/messages${query({ topic, after: next < 0 ? undefined : next, limit: MOST_MESSAGES })}`, signal);
    found.push(...page.messages.filter((message) => message.role === role));
    next = page.next;
  }
  // The columns of a topic do not say who sent what.
  const isShared = all.filter((one) => one.topic === topic).length > 1;
  const values = how === "values" && !isShared ? await get<Values>(`files/${cid}/values${query({ topic })}`, signal) : null;
  for (const message of found) made.add({ ...message, role, numbers: [] });
  made.complete(topic, role, messages, values?.at ?? [], values?.columns ?? []);
}

interface Page {
  messages: Message[];
  next: number | null;
}

const SHOWN = 50;

function TopicMessages(props: { cid: string; topic: TopicSummary }) {
  const { topic } = props;
  const [open, setOpen] = useState(false);
  return (
    <details class="topic" open={open} onToggle={(event) => setOpen(event.currentTarget.open)}>
      <summary>
        <code><Strange text={topic.topic} most={100} /></code>
        <Badge kind="calm">{topic.role === "objective" ? texts.playedTopic : texts.deviceTopic}</Badge>
        <span class="quiet">{topic.messages}× <Strange text={topic.types.join(", ")} most={80} /></span>
      </summary>
      {open ? <MessageList {...props} /> : null}
    </details>
  );
}

function MessageList(props: { cid: string; topic: TopicSummary }) {
  const [messages, setMessages] = useState<Message[]>([]);
  const [next, setNext] = useState<number | null>(0);
  const [error, setError] = useState<unknown>(null);
  const more = async () => {
    const fields = { topic: props.topic.topic, after: next || undefined, limit: SHOWN };
    const page = await getExact<Page>(`files/${props.cid}/messages${query(fields)}`);
    setMessages((known) => [...known, ...page.messages.filter((one) => one.role === props.topic.role)]);
    setNext(page.next);
  };
  useEffect(() => void more().catch(setError), []);
  if (error) return <Problem error={error} />;
  if (props.topic.shown === "image") {
    return (
      <>
        <div class="images">
          {messages.map((message) => message.image ? (
            <figure key={message.number}>
              <img src={message.image} alt={texts.imageAt(plain(message.topic, 60), duration(message.at))} loading="lazy" />
              <figcaption>{duration(message.at)}</figcaption>
            </figure>
          ) : null)}
        </div>
        {next !== null ? <Action class="button small quietly" run={more}>{texts.more}</Action> : null}
      </>
    );
  }
  return (
    <>
      <Table label={texts.messagesOf(plain(props.topic.topic, 60))} head={[texts.time, texts.value]} numbers={[0]}>
        {messages.map((message) => (
          <tr key={message.number}>
            <td class="right number">{duration(message.at)}</td>
            <td><bdi class="strange mono">{message.value === null ? "—" : shown(message.value)}{message.cut ? " …" : ""}</bdi></td>
          </tr>
        ))}
      </Table>
      {next !== null ? <Action class="button small quietly" run={more}>{texts.more}</Action> : null}
    </>
  );
}
