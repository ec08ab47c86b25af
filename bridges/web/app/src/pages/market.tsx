import { useEffect, useMemo, useRef, useState } from "preact/hooks";
import uPlot from "uplot";
import { formatUnits } from "viem";
import { get, query } from "../api";
import { useApp, useData, useTopic } from "../app";
import { amount, clock, plain, short } from "../format";
import { texts } from "../texts";
import type { Order, PastJob, StreamEvent, Token } from "../types";
import { Badge, Show } from "../ui";
import { plotColors, useScheme } from "../plot";
import { ModelFilter, robotsOf } from "./robots";

const SHOWN = 60;
const FLUSH = 100;
const SECONDS = 60;

interface Row {
  key: string;
  at: number;
  kind: string;
  who: string;
  text: string;
  price: string;
  href: string;
}

/** The market: what was paid before, who is here, and what happens now. */
export function MarketPage() {
  return (
    <>
      <h1>{texts.marketTitle}</h1>
      <History />
      <Ticker />
    </>
  );
}

interface Past {
  jobs: PastJob[];
}

/** What jobs have cost over time, by model, and how many there were. */
function History() {
  const { agents, market } = useApp();
  const [model, setModel] = useState("");
  const all = useData<Past>("market/history");
  const chosen = useData<Past>(model ? `market/history${query({ model })}` : null);
  const history = model ? chosen : all;
  const refresh = useRef(0);
  useTopic("chain", () => {
    if (Date.now() - refresh.current < 5_000) return;
    refresh.current = Date.now();
    all.reload();
    chosen.reload();
  });
  const models = [...new Set([...(all.data?.jobs ?? []).map((job) => job.model), ...robotsOf(agents?.agents).flatMap((robot) => robot.models)])].slice(0, 24);
  const jobs = useMemo(() => (history.data?.jobs ?? []).filter((job) => job.token.address === market.token.address), [history.data, market.token.address]);
  const paid = jobs.filter((job) => job.state === "paid").map((job) => BigInt(job.cost)).sort((one, other) => (one < other ? -1 : 1));
  const here = robotsOf(agents?.agents).filter((robot) => !model || robot.models.includes(model));
  return (
    <section>
      <ModelFilter models={models} model={model} choose={setModel} />
      <dl class="figures">
        <div><dt>{texts.robotsHere}</dt><dd>{here.length}</dd></div>
        <div><dt>{texts.jobsDone}</dt><dd>{paid.length.toLocaleString("en")}</dd></div>
        <div><dt>{texts.usualPrice}</dt><dd>{paid.length ? amount(paid[paid.length >> 1], market.token) : "—"}</dd></div>
        <div><dt>{texts.refundedShare}</dt><dd>{share(jobs)}</dd></div>
      </dl>
      <Show of={history}>{() => <Prices jobs={jobs} token={market.token} />}</Show>
    </section>
  );
}

/** Which part of the jobs that have ended was paid back. */
function share(jobs: PastJob[]): string {
  const ended = jobs.filter((job) => job.state !== "open");
  const back = ended.filter((job) => job.state !== "paid").length;
  return ended.length ? `${Math.round((100 * back) / ended.length)} %` : "—";
}

/** Each job as a point: when, and for how much. */
function Prices({ jobs, token }: { jobs: PastJob[]; token: Token }) {
  const box = useRef<HTMLDivElement>(null);
  const dark = useScheme();
  const points = useMemo(() => jobs.filter((job) => job.at !== null).map((job) => [job.at!, Number(formatUnits(BigInt(job.cost), token.decimals))]).reverse(), [jobs]);
  useEffect(() => {
    if (!box.current || points.length < 2) return;
    return chart(box.current, 180, ({ axis, line }) => ({
      axes: [axis, { ...axis, size: 56 }],
      scales: { y: { range: (_, __, most) => [0, most * 1.15 || 1] } },
      series: [{}, { stroke: line, paths: () => null, points: { show: true, size: 7, fill: line } }],
    }), [points.map(([at]) => at), points.map(([, price]) => price)]).stop;
  }, [points, dark]);
  if (points.length < 2) return <p class="quiet">{texts.noPrices}</p>;
  return (
    <>
      <p class="hint">{texts.pricesOver(plain(token.symbol, 32))}</p>
      <div class="plot" ref={box} role="img" aria-label={texts.pricesOver(plain(token.symbol, 32))} />
    </>
  );
}

/** What happens now: what comes is collected, and drawn ten times a second at most. */
function Ticker() {
  const { market } = useApp();
  const [rows, setRows] = useState<Row[]>([]);
  const [counts, setCounts] = useState<Record<string, number>>({});
  const [paused, setPaused] = useState(false);
  const waiting = useRef<Row[]>([]);
  const totals = useRef<Record<string, number>>({});
  const perSecond = useRef<number[]>(new Array(SECONDS).fill(0));
  const number = useRef(0);

  const add = (row: Omit<Row, "key">) => {
    waiting.current.push({ ...row, key: String(number.current++) });
    if (waiting.current.length > SHOWN) waiting.current.shift();
  };

  useTopic("market", (event) => {
    if (event.kind === "gap") return;
    totals.current[event.kind] = (totals.current[event.kind] ?? 0) + (event.kind === "lost" ? event.data.count : 1);
    if (event.kind === "lost") return;
    if (event.kind === "order") perSecond.current[SECONDS - 1]++;
    add(rowOf(event, (order) => amount(order.cost, market.token)));
  });

  useEffect(() => {
    get<{ orders: Order[] }>("orders?limit=60").then(({ orders }) => {
      for (const order of orders.reverse()) add(rowOf({ seq: 0, kind: "order", data: order, at: order.at }, (one) => amount(one.cost, market.token)));
    }).catch(() => {});
  }, []);

  useEffect(() => {
    if (paused) return;
    const timer = setInterval(() => {
      if (!waiting.current.length) return;
      const fresh = waiting.current.reverse();
      waiting.current = [];
      setRows((known) => [...fresh, ...known].slice(0, SHOWN));
      setCounts({ ...totals.current });
    }, FLUSH);
    return () => clearInterval(timer);
  }, [paused]);

  return (
    <>
      <div class="row between">
        <h2>{texts.rightNow}</h2>
        <button type="button" class="button small quietly" aria-pressed={paused} onClick={() => setPaused(!paused)}>{paused ? texts.goOn : texts.pause}</button>
      </div>
      <p class="inline counts">
        {Object.entries(counts).map(([kind, count]) => <Badge key={kind} kind={kind === "lost" ? "warn" : "calm"}>{texts.eventName[kind] ?? kind} {count.toLocaleString()}</Badge>)}
      </p>
      <p class="hint">{texts.ordersPerSecond}</p>
      <Rate perSecond={perSecond.current} />
      <div class="scroll" tabIndex={0} role="region" aria-label={texts.marketTitle}>
        <table class="cells ticker">
          <thead>
            <tr><th scope="col">{texts.time}</th><th scope="col">{texts.what}</th><th scope="col">{texts.who}</th><th scope="col" class="right">{texts.price}</th><th scope="col">{texts.about}</th></tr>
          </thead>
          <tbody>
            {rows.map((row) => (
              <tr key={row.key}>
                <td class="number">{clock(row.at)}</td>
                <td><span class={`kind ${row.kind}`}>{texts.eventName[row.kind] ?? row.kind}</span></td>
                <td class="mono">{row.who}</td>
                <td class="right number">{row.price}</td>
                <td class="mono">{row.href ? <a href={row.href}><bdi>{row.text}</bdi></a> : <bdi>{row.text}</bdi>}</td>
              </tr>
            ))}
          </tbody>
        </table>
        {!rows.length ? <p class="quiet">{texts.marketQuiet}</p> : null}
      </div>
    </>
  );
}

function rowOf(event: StreamEvent, price: (order: Order) => string): Omit<Row, "key"> {
  const { kind, at, data } = event;
  const row = { at, kind, who: "", text: "", price: "", href: "" };
  switch (kind) {
    case "order":
      return { ...row, kind: data.kind, who: short(data.signer), text: short(data.model), price: price(data), href: `#/order/${data.hash}` };
    case "result":
      return { ...row, who: short(data.signer), text: short(data.liability), href: `#/job/${data.liability}` };
    case "rejected":
    case "declined":
      return { ...row, who: short(data.agent), text: plain(`${data.code}: ${data.detail}`, 120) };
    case "job":
      return { ...row, who: short(data.agent), text: `${plain(data.event, 20)} ${short(data.liability.address)}`, href: `#/job/${data.liability.address}` };
    case "matched":
      return { ...row, text: short(data.liability.address), href: `#/job/${data.liability.address}` };
    default:
      return row;
  }
}

type Look = (colors: { axis: uPlot.Axis; line: string }) => Omit<uPlot.Options, "width" | "height">;

/** A plot as wide as its frame, in the colours of the page, until `stop`. */
function chart(frame: HTMLElement, height: number, look: Look, data: uPlot.AlignedData): { plot: uPlot; stop: () => void } {
  const { ink, grid, lines } = plotColors(frame);
  const axis = { stroke: ink, grid: { stroke: grid, width: 1 }, ticks: { stroke: grid } };
  const measure = () => ({ width: Math.max(240, frame.clientWidth), height });
  const plot = new uPlot({ ...measure(), cursor: { show: false }, legend: { show: false }, ...look({ axis, line: lines[0] }) }, data, frame);
  const resized = new ResizeObserver(() => plot.setSize(measure()));
  resized.observe(frame);
  const stop = () => {
    resized.disconnect();
    plot.destroy();
  };
  return { plot, stop };
}

/** Orders in each of the last sixty seconds. */
function Rate(props: { perSecond: number[] }) {
  const box = useRef<HTMLDivElement>(null);
  const dark = useScheme();
  useEffect(() => {
    const seconds = Array.from({ length: SECONDS }, (_, place) => place - SECONDS + 1);
    const { plot, stop } = chart(box.current!, 110, ({ axis, line }) => ({
      scales: { x: { time: false }, y: { range: (_, __, most) => [0, Math.max(5, most)] } },
      axes: [{ ...axis, values: (_, ticks) => ticks.map((tick) => `${tick} s`) }, { ...axis, size: 44 }],
      series: [{}, { stroke: line, width: 1.5, points: { show: false } }],
    }), [seconds, [...props.perSecond]]);
    const timer = setInterval(() => {
      plot.setData([seconds, [...props.perSecond]]);
      props.perSecond.shift();
      props.perSecond.push(0);
    }, 1000);
    return () => {
      clearInterval(timer);
      stop();
    };
  }, [dark]);
  return <div class="plot" ref={box} role="img" aria-label={texts.ordersPerSecond} />;
}
