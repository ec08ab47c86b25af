import { useEffect, useRef, useState } from "preact/hooks";
import uPlot from "uplot";
import "uplot/dist/uPlot.min.css";
import { get, getExact, query } from "../api";
import { useData, wordsOf } from "../app";
import { clock, duration, plain, shown, size } from "../format";
import { texts } from "../texts";
import type { Message, Summary, TopicSummary, Values } from "../types";
import { Action, Badge, Facts, Name, Problem, Show, Strange, Table } from "../ui";

const PAGE = 50;
const SERIES = 8;

export function FilePage(props: { cid: string }) {
  return (
    <>
      <h1>{texts.fileTitle} <Name text={props.cid} /></h1>
      <Recording cid={props.cid} />
    </>
  );
}

/** A recording's topics: values plotted, images shown, text listed. */
export function Recording(props: { cid: string }) {
  const summary = useData<Summary>(`files/${props.cid}/summary`);
  const address = `/api/v1/files/${props.cid}/recording.${summary.data?.format === "bag" ? "bag" : "mcap"}`;
  return (
    <>
      <Show of={summary}>
        {(known) => (
          <>
            <Facts
              of={[
                [texts.messages, String(known.messages)],
                [texts.duration, duration(Number(known.durationNs) / 1e9)],
                [texts.began, Number(known.startNs) > 1e15 ? clock(Number(known.startNs) / 1e9) : ""],
                [texts.size, size(known.size)],
              ]}
            />
            {known.topics.map((topic) => <Topic key={`${topic.role}${topic.topic}`} cid={props.cid} topic={topic} />)}
          </>
        )}
      </Show>
      <p class="row">
        <a class="button small quietly" href={address} download={`${props.cid}.${address.split(".").pop()}`}>{texts.download}</a>
        <a class="button small quietly" href={`foxglove://open?ds=remote-file&ds.url=${encodeURIComponent(location.origin + address)}`}>{texts.foxglove}</a>
      </p>
    </>
  );
}

function Topic(props: { cid: string; topic: TopicSummary }) {
  const { topic } = props;
  const [open, setOpen] = useState(topic.messages > 0 && topic.role === "device");
  return (
    <details class="topic" open={open} onToggle={(event) => setOpen(event.currentTarget.open)}>
      <summary>
        <code><Strange text={topic.topic} most={100} /></code>
        <Badge kind="calm">{topic.role === "objective" ? texts.playedTopic : texts.deviceTopic}</Badge>
        <span class="quiet">{topic.messages}× <Strange text={topic.types.join(", ")} most={80} /></span>
      </summary>
      {open && topic.shown === "values" ? <Plot {...props} /> : null}
      {open ? <MessageList {...props} /> : null}
    </details>
  );
}

function MessageList(props: { cid: string; topic: TopicSummary }) {
  const [messages, setMessages] = useState<Message[]>([]);
  const [next, setNext] = useState<number | null>(0);
  const [error, setError] = useState<unknown>(null);
  const more = async () => {
    const fields = { topic: props.topic.topic, after: next || undefined, limit: PAGE };
    const page = await getExact<{ messages: Message[]; next: number | null }>(`files/${props.cid}/messages${query(fields)}`);
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

/** The numbers of a topic over time. */
function Plot(props: { cid: string; topic: TopicSummary }) {
  const box = useRef<HTMLDivElement>(null);
  const [error, setError] = useState("");
  const [blank, setBlank] = useState(false);
  useEffect(() => {
    let plot: uPlot | null = null;
    const resized = new ResizeObserver(() => box.current && plot?.setSize(measure(box.current)));
    get<Values>(`files/${props.cid}/values${query({ topic: props.topic.topic })}`).then((values) => {
      if (!isLine(values)) setBlank(true);
      if (!box.current || !isLine(values)) return;
      plot = new uPlot(optionsOf(box.current, values), [values.at, ...values.columns.slice(0, SERIES).map((column) => column.values)], box.current);
      resized.observe(box.current);
    }, (problem) => setError(wordsOf(problem)));
    return () => {
      resized.disconnect();
      plot?.destroy();
    };
  }, []);
  if (blank) return null;
  return error ? <p class="hint">{error}</p> : <div class="plot" ref={box} role="img" aria-label={texts.plotOf(plain(props.topic.topic, 60))} />;
}

/** Whether there are numbers at two times to draw a line between; the table has them in any case. */
function isLine({ at, columns }: Values): boolean {
  return columns.slice(0, SERIES).some(({ values }) => new Set(at.filter((_, place) => typeof values[place] === "number")).size > 1);
}

const measure = (box: HTMLElement) => ({ width: Math.max(240, box.clientWidth), height: 200 });

export function plotColors(element: HTMLElement): { ink: string; grid: string; lines: string[] } {
  const probe = element.appendChild(document.createElement("i"));
  const color = (name: string) => {
    probe.style.color = `var(--${name})`;
    return getComputedStyle(probe).color;
  };
  const lines = Array.from({ length: SERIES }, (_, place) => color(`line-${place + 1}`));
  const colors = { ink: color("quiet"), grid: color("edge"), lines };
  probe.remove();
  return colors;
}

function optionsOf(box: HTMLElement, values: Values): uPlot.Options {
  const { ink, grid, lines } = plotColors(box);
  const axis = { stroke: ink, grid: { stroke: grid, width: 1 }, ticks: { stroke: grid } };
  return {
    ...measure(box),
    scales: { x: { time: false } },
    axes: [{ ...axis, values: (_, ticks) => ticks.map((tick) => `${tick} s`) }, axis],
    series: [
      { label: texts.time },
      ...values.columns.slice(0, SERIES).map((column, place) => ({
        label: plain(column.name, 40) || texts.value,
        stroke: lines[place],
        width: 1.5,
        points: { show: values.points < 60 },
      })),
    ],
  };
}
