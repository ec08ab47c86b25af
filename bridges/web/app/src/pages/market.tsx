import { useEffect, useRef, useState } from "preact/hooks";
import uPlot from "uplot";
import { get } from "../api";
import { useApp, useTopic } from "../app";
import { amount, clock, plain, short } from "../format";
import { plotColors } from "../plot";
import { texts } from "../texts";
import type { Order, StreamEvent } from "../types";
import { Badge } from "../ui";

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

/** The market as it moves: what comes is collected, and drawn ten times a second at most. */
export function MarketPage() {
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
        <h1>{texts.marketTitle}</h1>
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

/** Orders in each of the last sixty seconds. */
function Rate(props: { perSecond: number[] }) {
  const box = useRef<HTMLDivElement>(null);
  useEffect(() => {
    const { ink, grid, lines } = plotColors(box.current!);
    const seconds = Array.from({ length: SECONDS }, (_, place) => place - SECONDS + 1);
    const axis = { stroke: ink, grid: { stroke: grid, width: 1 }, ticks: { stroke: grid } };
    const frame = box.current!;
    const measure = () => ({ width: Math.max(240, frame.clientWidth), height: 110 });
    const plot = new uPlot({
      ...measure(),
      cursor: { show: false },
      legend: { show: false },
      scales: { x: { time: false }, y: { range: (_, __, most) => [0, Math.max(5, most)] } },
      axes: [{ ...axis, values: (_, ticks) => ticks.map((tick) => `${tick} s`) }, { ...axis, size: 44 }],
      series: [{}, { stroke: lines[0], width: 1.5, points: { show: false } }],
    }, [seconds, [...props.perSecond]], box.current!);
    const resized = new ResizeObserver(() => plot.setSize(measure()));
    resized.observe(box.current!);
    const timer = setInterval(() => {
      plot.setData([seconds, [...props.perSecond]]);
      props.perSecond.shift();
      props.perSecond.push(0);
    }, 1000);
    return () => {
      clearInterval(timer);
      resized.disconnect();
      plot.destroy();
    };
  }, []);
  return <div class="plot" ref={box} role="img" aria-label={texts.ordersPerSecond} />;
}
