// What comes on topics, live or from a recording, gathered by topic and bounded; and how each topic is best shown.

import type { Description, ModelTopic, ValueSchema } from "./types";

/** A message of a job or a robot. `at` is in Unix seconds when it is live, in seconds from the beginning of a recording. */
export interface Sample {
  topic: string;
  role: "device" | "objective";
  at: number;
  value: unknown;
  numbers: [string, number][];
  image: string | null;
  size: number;
  cut: boolean;
}

export interface Column {
  name: string;
  values: (number | null)[];
}

/** What is known of one topic, oldest first. */
export interface Track {
  topic: string;
  role: Sample["role"];
  /** Messages that came, also those that are not kept. */
  count: number;
  at: number[];
  columns: Column[];
  messages: { at: number; value: unknown; size: number; cut: boolean }[];
  pictures: { at: number; image: string }[];
}

export const MOST_TRACKS = 32;
export const MOST_POINTS = 2000;
export const MOST_COLUMNS = 32;
export const MOST_MESSAGES = 500;
export const MOST_PICTURES = 2000;
const IMAGE = /^(data:image\/(png|jpeg|gif|webp|bmp);base64,|\/api\/v1\/files\/)/;

/** The tracks of a job, a robot or a recording. Its memory is bounded, however long it gathers. */
export class Gathered {
  readonly tracks: Track[] = [];
  /** Samples taken; a drawing is up to date when it was made at this count. */
  count = 0;
  from = Infinity;
  to = -Infinity;
  private readonly known = new Map<string, Track>();
  private origin: number | null;

  /** With `fromFirst`, times count from the first sample. */
  constructor(fromFirst = false) {
    this.origin = fromFirst ? null : 0;
  }

  /** Takes a sample, unless it is older than the last of its topic, or its topic is one too many. */
  add(sample: Sample): void {
    this.origin ??= sample.at;
    const at = sample.at - this.origin;
    const track = this.track(sample.topic, sample.role);
    if (!track || !Number.isFinite(at) || at < lastTime(track)) return;
    track.count++;
    const isPicture = sample.image !== null && IMAGE.test(sample.image);
    track.messages.push({ at, value: isPicture ? null : sample.value, size: sample.size, cut: sample.cut });
    if (track.messages.length > 2 * MOST_MESSAGES) track.messages = track.messages.slice(-MOST_MESSAGES);
    if (isPicture) addPicture(track, at, sample.image!);
    else if (sample.numbers.length) addNumbers(track, at, sample.numbers);
    this.cover(at, at);
  }

  /** Takes how many messages a recording has of a topic, and its numbers in columns, as the server makes them. */
  complete(topic: string, role: Sample["role"], count: number, at: number[], columns: Column[]): void {
    const track = this.track(topic, role);
    if (!track) return;
    Object.assign(track, { count, at, columns });
    if (at.length) this.cover(at[0], at[at.length - 1]);
  }

  /** The same, if it is newer than the last of its topic: what comes twice is taken once. */
  addNew(sample: Sample): void {
    const track = this.known.get(`${sample.role} ${sample.topic}`);
    if (!track || sample.at - (this.origin ?? 0) > lastTime(track)) this.add(sample);
  }

  private track(topic: string, role: Sample["role"]): Track | undefined {
    const key = `${role} ${topic}`;
    const known = this.known.get(key);
    if (known || this.tracks.length === MOST_TRACKS) return known;
    const made: Track = { topic, role, count: 0, at: [], columns: [], messages: [], pictures: [] };
    this.known.set(key, made);
    this.tracks.push(made);
    return made;
  }

  private cover(from: number, to: number): void {
    this.count++;
    this.from = Math.min(this.from, from);
    this.to = Math.max(this.to, to);
  }
}

export function gather(samples: Sample[]): Gathered {
  const gathered = new Gathered(samples.length > 0 && samples[0].at > 1e9);
  for (const sample of samples) gathered.add(sample);
  return gathered;
}

const lastTime = (track: Track) => track.messages.at(-1)?.at ?? -Infinity;

/** A live picture holds its bytes, so the last one is kept; of a recording there are only addresses. */
function addPicture(track: Track, at: number, image: string): void {
  if (image.startsWith("data:")) track.pictures = [];
  track.pictures.push({ at, image });
  if (track.pictures.length > MOST_PICTURES) track.pictures = thinned(track.pictures);
}

function addNumbers(track: Track, at: number, numbers: Sample["numbers"]): void {
  const before = track.at.length;
  track.at.push(at);
  for (const [path, number] of numbers) {
    const name = path.replace(/^\./, "");
    let column = track.columns.find((one) => one.name === name);
    if (!column && track.columns.length < MOST_COLUMNS) track.columns.push((column = { name, values: new Array(before).fill(null) }));
    if (column && column.values.length === before) column.values.push(Number.isFinite(number) ? number : null);
  }
  for (const { values } of track.columns) if (values.length === before) values.push(null);
  if (track.at.length <= MOST_POINTS) return;
  track.at = thinned(track.at);
  for (const column of track.columns) column.values = thinned(column.values);
}

/** The newer half of a list, and each second of the older half: the whole time stays in view, finer where it is new. */
function thinned<T>(list: T[]): T[] {
  const half = list.length >> 1;
  return list.filter((_, place) => place >= half || place % 2 === 0);
}

/** The place of the last of the rising `times` that is not after `at`; -1 if all are. */
export function placeAt(times: number[], at: number): number {
  let [low, high] = [0, times.length];
  while (low < high) {
    const middle = (low + high) >> 1;
    if (times[middle] <= at) low = middle + 1;
    else high = middle;
  }
  return low - 1;
}

/** The last of `list` that is not after `until`. */
export function latest<T extends { at: number }>(list: T[], until?: number): T | undefined {
  return until === undefined ? list.at(-1) : list[placeAt(list.map((one) => one.at), until)];
}

/** The last number of a column up to a place. */
export function numberAt(values: (number | null)[], place: number): number | null {
  for (let from = Math.min(place, values.length - 1); from >= 0; from--) if (values[from] !== null) return values[from];
  return null;
}

/** That a text was said last, from one time to another. */
export interface State {
  text: string;
  from: number;
  to: number;
}

export const MOST_STATES = 60;

/** The states that texts tell of, up to the time `to`; none if there are too many words for states, or too long ones. */
export function statesOf(said: { at: number; text: string }[], to: number): State[] {
  const states: State[] = [];
  for (const { at, text } of said) {
    const last = states.at(-1);
    if (last) last.to = at;
    if (last?.text !== text) states.push({ text, from: at, to });
  }
  if (states.length) states[states.length - 1].to = to;
  const words = new Set(states.map((state) => state.text));
  const areStates = said.length >= 3 && words.size <= 6 && [...words].every((word) => word.length <= 24);
  return areStates ? states.slice(-MOST_STATES) : [];
}

/** What of a value is neither a number, which is plotted, nor the envelope of a message; undefined if that is nothing. */
export function withoutNumbers(value: unknown): unknown {
  if (typeof value === "string") return value;
  if (Array.isArray(value)) {
    const kept = value.map(withoutNumbers).filter((one) => one !== undefined);
    return kept.length ? kept : undefined;
  }
  if (typeof value !== "object" || value === null) return undefined;
  const kept = Object.entries(value).filter(([name]) => !DULL.test(name)).map(([name, one]) => [name, withoutNumbers(one)] as const).filter(([, one]) => one !== undefined);
  return kept.length ? Object.fromEntries(kept) : undefined;
}

/** A line of a plot. */
export interface Series {
  name: string;
  /** As the description calls it, else the name; empty for a number alone without a title. */
  title: string;
  unit: string;
  isBoolean: boolean;
}

export interface Position {
  x: string;
  y: string;
  /** The column with the angle from the x axis, against the clock. */
  angle: string | null;
  angleInDegrees: boolean;
  /** x is a longitude and y a latitude. */
  onEarth: boolean;
  unit: string;
}

/** How a topic is shown: a title, a path, and plots of which each has one unit. Pictures and lines need no choice. */
export interface View {
  title: string;
  position: Position | null;
  plots: Series[][];
}

/** What is part of a message's envelope, or fills a plot without telling a person anything. */
const DULL = /(^|[._])(header|stamp|covariance|seq)([._[]|$)/i;
/** Vectors whose x and y are no place. */
const NO_PLACE = /(linear|angular|velocity|twist|acceleration|force|torque|orientation|rotation|scale|size|magnetic)/i;
const EARTH = [["latitude", "longitude"], ["lat", "lon"], ["lat", "lng"]];
const MOST_PLOTS = 6;

export function viewOf(track: Track, model: Description | null): View {
  const described = topicOf(model, track);
  const value = track.messages.at(-1)?.value;
  const series = track.columns.filter(({ name }) => !DULL.test(name)).map(({ name }) => seriesOf(described?.value ?? {}, value, name));
  const found = positionOf(series);
  const position = found && (moves(track, found.x) || moves(track, found.y)) ? found : null;
  const groups = new Map<string, Series[]>();
  for (const one of series) {
    if (position && (one.name === position.x || one.name === position.y)) continue;
    const key = one.isBoolean ? "boolean" : `unit ${one.unit}`;
    groups.set(key, [...(groups.get(key) ?? []), one]);
  }
  return { title: described?.title || described?.value?.title || wordsOf(track.topic), position, plots: [...groups.values()].slice(0, MOST_PLOTS) };
}

/** A topic's name for people: `/arm/left_grip` is "Arm left grip". */
function wordsOf(topic: string): string {
  const words = topic.replace(/[/_]+/g, " ").trim() || topic;
  return words.charAt(0).toUpperCase() + words.slice(1);
}

export function topicOf(model: Description | null, track: Track): ModelTopic | undefined {
  return (track.role === "device" ? model?.result : model?.objective)?.find((one) => one.topic === track.topic);
}

/** The tracks in the order of the description: what the robot sent, then what was played. */
export function inOrder(tracks: Track[], model: Description | null): Track[] {
  const place = (track: Track) => {
    const listed = (track.role === "device" ? model?.result : model?.objective)?.findIndex((one) => one.topic === track.topic) ?? -1;
    return (track.role === "device" ? 0 : 2000) + (listed < 0 ? 1000 : listed);
  };
  return [...tracks].sort((one, other) => place(one) - place(other));
}

/** The field at a path such as `linear.x` or `joints[0]`. The `data` of a ROS message is the value itself. */
function seriesOf(schema: ValueSchema, value: unknown, name: string): Series {
  let field = schema;
  let found = value;
  let title = schema.type === "object" || schema.type === "array" ? "" : schema.title ?? "";
  let number = "";
  for (const part of name.match(/[^.[\]]+/g) ?? []) {
    found = typeof found === "object" && found !== null ? (found as Record<string, unknown>)[part] : undefined;
    if (part === "data" && name === "data" && !field.properties) continue;
    if (/^\d+$/.test(part) && !field.properties) number = ` ${Number(part) + 1}`;
    field = field.properties?.[part] ?? (number ? { title: field.title, ...field.items } : {});
    title = field.title ? field.title + number : "";
  }
  const plainName = name === "data" ? "" : name.replaceAll(".", " ").replaceAll("_", " ");
  return { name, title: title || plainName, unit: field.unit ?? "", isBoolean: field.type === "boolean" || typeof found === "boolean" };
}

const moves = (track: Track, name: string) => new Set(columnOf(track, name).filter((one) => one !== null)).size > 1;

function positionOf(series: Series[]): Position | null {
  const known = new Map(series.map((one) => [one.name.toLowerCase(), one]));
  for (const { name } of series) {
    const [all, prefix, last] = /^((?:.*[._])?)([a-z]+)$/i.exec(name) ?? [];
    if (all === undefined || NO_PLACE.test(prefix)) continue;
    const beside = (other: string) => known.get((prefix + other).toLowerCase());
    for (const [latitude, longitude] of EARTH) {
      const [y, x] = [beside(latitude), beside(longitude)];
      if (last.toLowerCase() === latitude && x && y) return { x: x.name, y: y.name, angle: null, angleInDegrees: false, onEarth: true, unit: "" };
    }
    const [x, y] = [beside("x"), beside("y")];
    if (last.toLowerCase() !== "x" || !x || !y || beside("w") || /\//.test(x.unit) || x.isBoolean) continue;
    const angle = beside("theta") ?? beside("yaw");
    return { x: x.name, y: y.name, angle: angle?.name ?? null, angleInDegrees: /^(°|deg)/.test(angle?.unit ?? ""), onEarth: false, unit: x.unit };
  }
  return null;
}

/** Places on a plane, in metres from the middle if they were on the earth. Those without both numbers are left out. */
export function placesOf(track: Track, position: Position): { at: number; x: number; y: number }[] {
  const [xs, ys] = [columnOf(track, position.x), columnOf(track, position.y)];
  const places = track.at.flatMap((at, place) => {
    const [x, y] = [xs[place], ys[place]];
    return x === null || y === null || x === undefined || y === undefined || (position.onEarth && (Math.abs(y) > 90 || Math.abs(x) > 180)) ? [] : [{ at, x, y }];
  });
  if (!position.onEarth || !places.length) return places;
  const { x: east, y: north } = places[0];
  const metres = 111_320;
  return places.map(({ at, x, y }) => ({ at, x: (x - east) * metres * Math.cos((north * Math.PI) / 180), y: (y - north) * metres }));
}

export function columnOf(track: Track, name: string): (number | null)[] {
  return track.columns.find((column) => column.name === name)?.values ?? [];
}

/** A number as people read it: as many digits as tell something. */
export function figure(number: number): string {
  const size = Math.abs(number);
  if (size >= 1e9 || (size > 0 && size < 1e-3)) return number.toExponential(2).replace("e+", "e");
  if (Number.isInteger(number)) return grouped(String(number));
  return grouped(number.toFixed(size >= 1000 ? 0 : size >= 100 ? 1 : size >= 1 ? 2 : 3));
}

/** A number on an axis whose numbers are `step` apart: with as many decimals as tell them apart. */
export function tickText(tick: number, step: number): string {
  const digits = String(step).split(".")[1]?.length ?? 0;
  return step < 1e-5 || Math.abs(tick) >= 1e9 ? figure(tick) : grouped(tick.toFixed(digits));
}

const grouped = (number: string) => number.replace(/^(-?\d+)/, (whole) => whole.replace(/\B(?=(\d{3})+$)/g, " ")).replace("-", "−");

/** Seconds from a beginning: 3.2 s, 2:05, 1:02:05. */
export function elapsed(seconds: number, digits = 1): string {
  if (seconds < 60) return `${seconds.toFixed(digits)} s`;
  const whole = Math.floor(seconds);
  const parts = [Math.floor(whole / 3600), Math.floor(whole / 60) % 60, whole % 60];
  return (parts[0] ? parts : parts.slice(1)).map((part, place) => (place ? String(part).padStart(2, "0") : part)).join(":");
}

/** The length of a scale bar: 1, 2 or 5 times a power of ten, at most `most`. */
export function roundLength(most: number): number {
  const power = 10 ** Math.floor(Math.log10(most));
  return (most / power >= 5 ? 5 : most / power >= 2 ? 2 : 1) * power;
}
