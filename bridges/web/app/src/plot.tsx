// Drawings of numbers: plots over time, and paths on a plane. Each is drawn once a frame, when something changed.

import { useEffect, useMemo, useRef, useState } from "preact/hooks";
import uPlot from "uplot";
import "uplot/dist/uPlot.min.css";
import { plain } from "./format";
import { texts } from "./texts";
import { columnOf, elapsed, figure, numberAt, placeAt, placesOf, roundLength, tickText } from "./tracks";
import type { Position, Series, Track } from "./tracks";

const SERIES = 8;
const HEIGHT = 144;

/** The times in view, and how they are drawn. */
export interface Frame {
  from: () => number;
  to: () => number;
  /** Times are clock times, in Unix seconds. */
  clock: boolean;
  /** What is another text when there is something new to draw. */
  news: () => string;
  until?: number;
  seek?: (at: number) => void;
}

export function plotColors(element: HTMLElement): { ink: string; grid: string; ground: string; lines: string[] } {
  const probe = element.appendChild(document.createElement("i"));
  const color = (name: string) => {
    probe.style.color = `var(--${name})`;
    return getComputedStyle(probe).color;
  };
  const lines = Array.from({ length: SERIES }, (_, place) => color(`line-${place + 1}`));
  const colors = { ink: color("quiet"), grid: color("edge"), ground: color("panel"), lines };
  probe.remove();
  return colors;
}

/** Changes when the colours do. */
export function useScheme(): boolean {
  const query = useMemo(() => matchMedia("(prefers-color-scheme: dark)"), []);
  const [dark, setDark] = useState(query.matches);
  useEffect(() => {
    const changed = () => setDark(query.matches);
    query.addEventListener("change", changed);
    return () => query.removeEventListener("change", changed);
  }, []);
  return dark;
}

/** Milliseconds of a frame in which drawings may begin; the others wait for the next one. */
const BUDGET = 4;

/** Drawings that are on the screen: each frame makes as many of those with news as it has time for, in turn. */
const drawings: { news: () => string; draw: () => void; seen: string }[] = [];
let planned = 0;

function drawNext(): void {
  planned = requestAnimationFrame(drawNext);
  const end = performance.now() + BUDGET;
  for (let left = drawings.length; left > 0 && performance.now() < end; left--) {
    const first = drawings.shift()!;
    drawings.push(first);
    const now = first.news();
    if (now === first.seen) continue;
    first.seen = now;
    first.draw();
  }
}

/** Calls `draw` when there is news, while the element is on the screen. */
function useDrawing(box: { current: HTMLElement | null }, news: Frame["news"], draw: () => void, isThere: boolean): void {
  const latest = useRef({ news, draw });
  latest.current = { news, draw };
  useEffect(() => {
    if (!isThere || !box.current) return;
    const drawing = { news: () => latest.current.news(), draw: () => latest.current.draw(), seen: "" };
    const leave = () => {
      const place = drawings.indexOf(drawing);
      if (place >= 0) drawings.splice(place, 1);
      if (drawings.length || !planned) return;
      cancelAnimationFrame(planned);
      planned = 0;
    };
    const watch = new IntersectionObserver((entries) => {
      leave();
      if (!entries.at(-1)!.isIntersecting) return;
      drawings.push(drawing);
      if (!planned) planned = requestAnimationFrame(drawNext);
    });
    watch.observe(box.current);
    return () => {
      watch.disconnect();
      leave();
    };
  }, [isThere]);
}

/** Numbers of one unit over time, and what they are at the time that is pointed at. */
export function Plot(props: { track: Track; series: Series[]; title: string; frame: Frame }) {
  const { track, frame } = props;
  const series = props.series.slice(0, SERIES);
  const box = useRef<HTMLDivElement>(null);
  const plot = useRef<uPlot | null>(null);
  const dark = useScheme();
  const [hidden, setHidden] = useState<string[]>([]);
  const [pointed, setPointed] = useState<number | null>(null);
  const latest = useRef(frame);
  latest.current = frame;
  const isLine = track.at.length > 1 && track.at[0] < track.at[track.at.length - 1];
  const names = series.map((one) => one.name).join("\n");

  const draw = () => {
    const now = plot.current;
    if (!now) return;
    now.batch(() => {
      now.setData([track.at, ...series.map((one) => columnOf(track, one.name))], false);
      now.setScale("x", { min: latest.current.from(), max: latest.current.to() });
    });
  };

  /** What has not happened yet at the time that is shown lies behind a veil. */
  const veil = () => {
    const cover = plot.current?.over.querySelector<HTMLElement>(".veil");
    const { until } = latest.current;
    if (!cover) return;
    cover.hidden = until === undefined;
    if (until !== undefined) cover.style.left = `${Math.max(0, plot.current!.valToPos(until, "x"))}px`;
  };

  useEffect(() => {
    if (!isLine || !box.current) return;
    const element = box.current;
    const measure = () => ({ width: Math.max(200, element.clientWidth), height: HEIGHT });
    const made = new uPlot(optionsOf(element, series, track, frame.clock, setPointed, veil), undefined, element);
    plot.current = made;
    made.over.append(Object.assign(document.createElement("i"), { className: "veil" }));
    made.setSize(measure());
    draw();
    const resized = new ResizeObserver(() => made.setSize(measure()));
    resized.observe(element);
    const seek = () => made.cursor.left !== undefined && made.cursor.left >= 0 && latest.current.seek?.(made.posToVal(made.cursor.left, "x"));
    made.over.addEventListener("click", seek);
    return () => {
      resized.disconnect();
      made.destroy();
      plot.current = null;
    };
  }, [isLine, names, dark, frame.clock]);
  useEffect(veil, [frame.until]);
  useEffect(() => series.forEach((one, place) => plot.current?.setSeries(place + 1, { show: !hidden.includes(one.name) })), [hidden, dark]);
  useDrawing(box, frame.news, draw, isLine);

  const until = frame.until === undefined ? track.at.length - 1 : placeAt(track.at, frame.until);
  return (
    <div class="plotted">
      <ul class="legend">
        {series.map((one, place) => {
          const number = numberAt(columnOf(track, one.name), pointed ?? until);
          const content = (
            <>
              {isLine ? <span class="swatch" style={{ background: `var(--line-${place + 1})` }} aria-hidden="true" /> : null}
              <span class="what">{one.title === props.title ? "" : plain(one.title, 40) || (series.length > 1 ? texts.value : "")}</span>
              <span class="figure">
                {number === null ? "–" : one.isBoolean ? (number ? texts.yes : texts.no) : figure(number)}
                {one.unit && number !== null ? <small> {plain(one.unit, 12)}</small> : null}
              </span>
            </>
          );
          const toggle = () => setHidden((known) => known.includes(one.name) ? known.filter((name) => name !== one.name) : [...known, one.name]);
          return (
            <li key={one.name}>
              {series.length > 1 && isLine ? <button type="button" aria-pressed={!hidden.includes(one.name)} onClick={toggle}>{content}</button> : content}
            </li>
          );
        })}
      </ul>
      {props.series.length > SERIES ? <p class="hint">{texts.moreNumbers(props.series.length - SERIES)}</p> : null}
      {isLine ? <div class="plot" ref={box} role="img" aria-label={texts.plotOf(props.title)} /> : null}
    </div>
  );
}

function optionsOf(element: HTMLElement, series: Series[], track: Track, isClock: boolean, point: (place: number | null) => void, drawn: () => void): uPlot.Options {
  const { ink, grid, lines } = plotColors(element);
  const font = "12px system-ui, sans-serif";
  const axis: uPlot.Axis = { stroke: ink, font, grid: { stroke: grid, width: 1 }, ticks: { show: false } };
  const clock = (tick: number, step: number) => new Date(tick * 1000).toLocaleTimeString(undefined, { hour: "2-digit", minute: "2-digit", second: step < 60 ? "2-digit" : undefined });
  return {
    width: 200,
    height: HEIGHT,
    padding: [8, isClock ? 26 : 14, 0, 0],
    legend: { show: false },
    cursor: { y: false, drag: { x: false, y: false }, sync: { key: "aira-tracks" }, points: { size: 7 } },
    scales: { x: { time: isClock }, ...(series[0].isBoolean ? { y: { range: [-0.1, 1.1] } } : {}) },
    axes: [
      { ...axis, size: 26, space: 70, grid: { show: false }, values: (_, ticks, __, ___, step) => ticks.map((tick) => isClock ? clock(tick, step) : elapsed(tick, Number.isInteger(tick) ? 0 : 1)) },
      { ...axis, size: (_, ticks) => 14 + 7 * Math.max(2, ...(ticks ?? []).map((tick) => tick.length)), space: 34,
        values: (_, ticks, __, ___, step) => ticks.map((tick) => !series[0].isBoolean ? tickText(tick, step) : tick === 0 ? texts.no : tick === 1 ? texts.yes : "") },
    ],
    series: [
      {},
      ...series.map((one, place): uPlot.Series => ({
        stroke: lines[place],
        fill: series.length === 1 && !one.isBoolean ? fading(lines[place]) : undefined,
        fillTo: (plot) => plot.scales.y.min ?? 0,
        width: 1.75,
        spanGaps: true,
        paths: one.isBoolean ? uPlot.paths.stepped!({ align: 1 }) : undefined,
        points: { show: () => track.at.length < 40, size: 5 },
      })),
    ],
    hooks: {
      setCursor: [(plot) => point(plot.cursor.left !== undefined && plot.cursor.left >= 0 ? plot.cursor.idx ?? null : null)],
      draw: [drawn],
    },
  };
}

/** A line's colour, strong below the line and nothing at the bottom. */
function fading(color: string): (plot: uPlot) => CanvasGradient | string {
  return ({ ctx, bbox }) => {
    if (!Number.isFinite(bbox.height) || !bbox.height) return "transparent";
    const gradient = ctx.createLinearGradient(0, bbox.top, 0, bbox.top + bbox.height);
    gradient.addColorStop(0, color.replace("rgb(", "rgba(").replace(")", ", 0.22)"));
    gradient.addColorStop(1, color.replace("rgb(", "rgba(").replace(")", ", 0)"));
    return gradient;
  };
}

/** Where something went: its path on a plane with one scale for both directions, north or y at the top. */
export function Path(props: { track: Track; position: Position; label: string; frame: Frame }) {
  const { track, position, frame } = props;
  const box = useRef<HTMLCanvasElement>(null);
  const dark = useScheme();
  const colors = useRef<ReturnType<typeof plotColors> | null>(null);
  const measured = useRef({ width: 0, height: 0 });
  const draw = () => {
    if (box.current && measured.current.width && colors.current) drawPath(box.current, measured.current, colors.current, track, position, frame.until);
  };
  const redraw = useRef(draw);
  redraw.current = draw;
  useEffect(() => {
    colors.current = plotColors(box.current!.parentElement!);
    draw();
  }, [dark]);
  useEffect(() => {
    const resized = new ResizeObserver(([{ contentRect: { width, height } }]) => {
      measured.current = { width, height };
      redraw.current();
    });
    resized.observe(box.current!);
    return () => resized.disconnect();
  }, []);
  useDrawing(box, () => `${frame.news()} ${frame.until}`, draw, true);
  const place = frame.until === undefined ? track.at.length - 1 : placeAt(track.at, frame.until);
  const [x, y] = [numberAt(columnOf(track, position.x), place), numberAt(columnOf(track, position.y), place)];
  return (
    <figure class="path">
      <canvas ref={box} role="img" aria-label={props.label} />
      <figcaption class="figure">{x === null || y === null ? "–" : position.onEarth ? texts.onEarth(y, x) : texts.onPlane(figure(x), figure(y), plain(position.unit, 12))}</figcaption>
    </figure>
  );
}

function drawPath(canvas: HTMLCanvasElement, { width, height }: { width: number; height: number }, colors: ReturnType<typeof plotColors>, track: Track, position: Position, until?: number): void {
  const ratio = devicePixelRatio;
  if (canvas.width !== Math.round(width * ratio)) canvas.width = Math.round(width * ratio);
  if (canvas.height !== Math.round(height * ratio)) canvas.height = Math.round(height * ratio);
  const context = canvas.getContext("2d")!;
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.clearRect(0, 0, width, height);
  const places = placesOf(track, position);
  if (!places.length) return;

  const bound = (pick: (one: { x: number; y: number }) => number) => places.reduce(([least, most], one) => [Math.min(least, pick(one)), Math.max(most, pick(one))], [Infinity, -Infinity]);
  const [[left, right], [bottom, top]] = [bound((one) => one.x), bound((one) => one.y)];
  const margin = 26;
  const smallest = position.onEarth ? 4 : Math.max(1e-6, Math.abs(left) / 1e6);
  const scale = Math.min((width - 2 * margin) / Math.max(right - left, smallest), (height - 2 * margin) / Math.max(top - bottom, smallest));
  const toX = (x: number) => width / 2 + (x - (left + right) / 2) * scale;
  const toY = (y: number) => height / 2 - (y - (bottom + top) / 2) * scale;

  // A grid whose squares have a round size.
  const square = roundLength(110 / scale);
  context.strokeStyle = colors.grid;
  context.lineWidth = 1;
  context.beginPath();
  const [firstX, firstY] = [(left + right) / 2 - width / 2 / scale, (bottom + top) / 2 - height / 2 / scale];
  for (let x = Math.ceil(firstX / square) * square; toX(x) <= width; x += square) {
    context.moveTo(Math.round(toX(x)) + 0.5, 0);
    context.lineTo(Math.round(toX(x)) + 0.5, height);
  }
  for (let y = Math.ceil(firstY / square) * square; toY(y) >= 0; y += square) {
    context.moveTo(0, Math.round(toY(y)) + 0.5);
    context.lineTo(width, Math.round(toY(y)) + 0.5);
  }
  context.stroke();

  const now = until === undefined ? places.length - 1 : placeAt(places.map((one) => one.at), until);
  const stroke = (from: number, to: number, opacity: number, thickness: number) => {
    if (to <= from) return;
    context.globalAlpha = opacity;
    context.lineWidth = thickness;
    context.lineJoin = context.lineCap = "round";
    context.strokeStyle = colors.lines[0];
    context.beginPath();
    for (let place = from; place <= to; place++) context.lineTo(toX(places[place].x), toY(places[place].y));
    context.stroke();
    context.globalAlpha = 1;
  };
  stroke(Math.max(0, now), places.length - 1, 0.25, 2);
  stroke(0, now, 1, 2.5);

  const dot = (place: number, radius: number, fill: string, edge: string) => {
    context.beginPath();
    context.arc(toX(places[place].x), toY(places[place].y), radius, 0, 7);
    context.fillStyle = fill;
    context.fill();
    context.lineWidth = 2;
    context.strokeStyle = edge;
    context.stroke();
  };
  dot(0, 4, colors.ground, colors.lines[0]);
  if (now >= 0) {
    const angle = position.angle ? numberAt(columnOf(track, position.angle), placeAt(track.at, places[now].at)) : null;
    if (angle !== null) {
      const turned = position.angleInDegrees ? (angle * Math.PI) / 180 : angle;
      context.beginPath();
      context.moveTo(toX(places[now].x), toY(places[now].y));
      context.lineTo(toX(places[now].x) + 18 * Math.cos(turned), toY(places[now].y) - 18 * Math.sin(turned));
      context.lineWidth = 4;
      context.strokeStyle = colors.lines[1];
      context.stroke();
    }
    dot(now, 6.5, colors.lines[1], colors.ground);
  }

  context.fillStyle = context.strokeStyle = colors.ink;
  context.lineWidth = 2;
  context.font = "12px system-ui, sans-serif";
  context.beginPath();
  context.moveTo(12, height - 16);
  context.lineTo(12, height - 10);
  context.lineTo(12 + square * scale, height - 10);
  context.lineTo(12 + square * scale, height - 16);
  context.stroke();
  const unit = position.onEarth ? "m" : plain(position.unit, 8);
  context.fillText(`${figure(square)} ${unit}`, 18, height - 16);
  if (position.onEarth) context.fillText(texts.north, width - 34, 20);
}
