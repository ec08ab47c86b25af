import { useEffect, useMemo, useState } from "preact/hooks";
import { get, postFile, postText, query } from "../api";
import { useApp, wordsOf } from "../app";
import { isCid } from "../cid";
import { duration, size } from "../format";
import { texts } from "../texts";
import { checkUpload } from "../trust";
import type { Model, ModelTopic, Objective, Summary, ValueSchema } from "../types";
import { Badge, Field, Name, NumberField, Strange, WordField } from "../ui";
import { initialEntry, rangeWords, readEntry, readNumber } from "../values";
import type { Entry } from "../values";

interface Line {
  topic: ModelTopic;
  entry: Entry;
  at: string;
}

/** What a person says the robot should do, as the fields have it. */
export interface Choice {
  way: "form" | "file" | "cid" | "none";
  lines: Line[];
  file: File | null;
  cid: string;
}

/** Makes the objective that a choice means. */
export type Make = () => Promise<Objective>;

const described = (model: Model) => model.description?.objective ?? [];
const newLine = (topic: ModelTopic, at: string): Line => ({ topic, at, entry: initialEntry(topic.value ?? {}) });
const FITS = { ok: true, reason: "", detail: "" };
const AT: ValueSchema = { type: "number", minimum: 0 };

/** A model whose file nobody has. */
export function withoutDescription(cid: string): Model {
  return { cid, described: false, description: null, text: null };
}

export function firstChoice(model: Model): Choice {
  const topics = described(model);
  const required = topics.filter((topic) => topic.required);
  const lines = (required.length ? required : topics.slice(0, 1)).map((topic) => newLine(topic, "0"));
  return { way: topics.length ? "form" : "file", lines, file: null, cid: "" };
}

/** Makes the objective of exactly this choice, once; null while a field can't be used. */
export function useObjective(model: Model, choice: Choice): Make | null {
  const { market } = useApp();
  return useMemo(() => {
    const make = makerOf(model, choice, market.limits.upload);
    let made: Promise<Objective> | null = null;
    return make && (() => (made ??= make().catch((error) => { made = null; throw error; })));
  }, [model, choice]);
}

function makerOf(model: Model, choice: Choice, largest: number): Make | null {
  const { way, lines, file, cid } = choice;
  if (way === "none") return async () => noObjective(model.cid);
  if (way === "cid") return isCid(cid) ? () => objectiveOf(cid, model) : null;
  if (way === "form") {
    const form = formOf(model.cid, lines);
    return form === null ? null : () => postText<Objective>("objectives/form", form);
  }
  if (!file || file.size > largest) return null;
  return async () => {
    const objective = await postFile<Objective>(`objectives${query({ model: model.cid })}`, file);
    await checkUpload(new Uint8Array(await file.arrayBuffer()), objective.cid);
    return objective;
  };
}

/** The request for the objective of a form; null while a field is wrong. */
function formOf(model: string, lines: Line[]): string | null {
  const values = lines.map(({ topic, entry, at }) => {
    const value = readEntry(topic.value ?? {}, entry);
    const time = lines.length > 1 ? readNumber(AT, at) : { json: "0" };
    return value.fault !== undefined || time.fault !== undefined ? null : `{"topic":${JSON.stringify(topic.topic)},"value":${value.json},"at":${time.json}}`;
  });
  return values.length && !values.includes(null) ? `{"model":${JSON.stringify(model)},"values":[${values.join(",")}]}` : null;
}

/** The objective with a CID; the model's own means none. */
export async function objectiveOf(cid: string, model: Model): Promise<Objective> {
  if (cid === model.cid) return noObjective(cid);
  const [summary, preflight] = await Promise.all([
    get<Summary>(`files/${cid}/summary`),
    model.described ? get<Objective["preflight"]>(`files/${cid}/preflight${query({ model: model.cid })}`) : FITS,
  ]);
  return { cid, size: summary.size, summary, preflight };
}

/** Robots that need no objective, such as sensors, are ordered by naming the model in its place. Nobody need have its file. */
function noObjective(model: string): Objective {
  const summary = { cid: model, format: "", size: 0, messages: 0, startNs: "0", durationNs: "0", topics: [], metadata: {}, attachments: [] };
  return { cid: model, size: 0, summary, preflight: FITS };
}

/** The ways to an objective: a form made from the model's description, a file, a CID, or none. */
export function ObjectiveChoice(props: { model: Model; choice: Choice; make: Make | null; change: (choice: Choice) => void }) {
  const { model, choice, change } = props;
  const ways = described(model).length ? (["form", "file", "cid"] as const) : (["file", "cid", "none"] as const);
  return (
    <>
      <div class="tabs" role="tablist" aria-label={texts.chooseObjective}>
        {ways.map((one) => (
          <button key={one} id={`way-${one}`} type="button" role="tab" aria-selected={choice.way === one} class="tab" onClick={() => change({ ...choice, way: one, file: null })}>{texts.ways[one]}</button>
        ))}
      </div>
      {choice.way === "form" ? <DescribedForm model={model} lines={choice.lines} change={(lines) => change({ ...choice, lines })} /> : null}
      {choice.way === "file" ? <FileChoice file={choice.file} change={(file) => change({ ...choice, file })} /> : null}
      {choice.way === "cid" ? (
        <WordField label={texts.objectiveCid} text={choice.cid} change={(cid) => change({ ...choice, cid })} error={choice.cid && !isCid(choice.cid) ? texts.notACid : ""} hint={texts.objectiveCidHint} />
      ) : null}
      {choice.way === "none" ? <p class="hint">{texts.noObjectiveHint}</p> : null}
      {choice.way === "file" || choice.way === "cid" ? <Preview make={props.make} described={model.described} /> : null}
    </>
  );
}

/** The file or CID that was chosen, as soon as it is known. */
function Preview(props: { make: Make | null; described: boolean }) {
  const { make } = props;
  const [found, setFound] = useState<{ of: Make; objective?: Objective; error?: unknown } | null>(null);
  useEffect(() => {
    make?.().then((objective) => setFound({ of: make, objective }), (error) => setFound({ of: make, error }));
  }, [make]);
  if (make === null) return null;
  if (found?.of !== make) return <p class="quiet" aria-busy="true">{texts.loading}</p>;
  if (!found.objective) return <p class="problem" role="alert">{wordsOf(found.error)}</p>;
  return <div class="chosen-objective"><Fit objective={found.objective} described={props.described} /></div>;
}

/** Whether an objective fits its model, and what is in it. */
export function Fit({ objective, described }: { objective: Objective; described: boolean }) {
  const { summary, preflight } = objective;
  return (
    <>
      <p>
        <Badge kind={!preflight.ok ? "bad" : described ? "good" : "calm"}>{!preflight.ok ? texts.fitsNot : described ? texts.fits : texts.unchecked}</Badge>{" "}
        <Name text={objective.cid} /> {texts.objectiveSummary(summary.messages, summary.durationNs === "0" ? "" : duration(Number(summary.durationNs) / 1e9), size(summary.size))}
      </p>
      {preflight.ok ? null : <p class="problem" role="alert"><Strange text={preflight.detail} /> <code>{preflight.reason}</code></p>}
      <ul class="inline">{summary.topics.slice(0, 12).map((topic) => <li key={topic.topic}><code><Strange text={topic.topic} most={60} /></code> {topic.messages}×</li>)}</ul>
    </>
  );
}

function FileChoice(props: { file: File | null; change: (file: File | null) => void }) {
  const { market } = useApp();
  const tooLarge = props.file !== null && props.file.size > market.limits.upload;
  return (
    <Field label={texts.file} hint={texts.fileHint(size(market.limits.upload))} error={tooLarge ? texts.fileTooLarge : ""}>
      {(id, hint) => <input id={id} aria-describedby={hint} type="file" accept=".mcap,.bag" onChange={(event) => props.change(event.currentTarget.files?.[0] ?? null)} />}
    </Field>
  );
}

/** A form of messages, as the model describes them: each line is a message on a topic at a time. */
function DescribedForm(props: { model: Model; lines: Line[]; change: (lines: Line[]) => void }) {
  const { model, lines, change } = props;
  const most = model.description!.limits?.messages ?? 200;
  const set = (place: number, fields: Partial<Line>) => change(lines.map((one, at) => (at === place ? { ...one, ...fields } : one)));
  const next = () => String(Math.floor(Math.max(-1, ...lines.map((one) => Number(one.at) || 0))) + 1);
  return (
    <div class="form">
      {lines.map((one, place) => (
        <fieldset key={place}>
          <legend><Strange text={one.topic.title || one.topic.topic} most={80} /> {lines.length > 1 ? `· ${place + 1}` : ""}</legend>
          {one.topic.description ? <p class="hint"><Strange text={one.topic.description} /></p> : null}
          <EntryInput schema={one.topic.value ?? {}} entry={one.entry} label={one.topic.value?.title || one.topic.title || texts.value} needed change={(entry) => set(place, { entry })} />
          {lines.length > 1 ? (
            <div class="row end">
              <NumberField label={texts.atSecond} text={one.at} class="narrow" change={(at) => set(place, { at })} error={readNumber(AT, one.at).fault} />
              <button type="button" class="button small quietly" onClick={() => change(lines.filter((_, at) => at !== place))}>{texts.remove}</button>
            </div>
          ) : null}
        </fieldset>
      ))}
      <p class="row">
        {described(model).map((topic) => (
          <button key={topic.topic} type="button" class="button small quietly" disabled={lines.length >= most || lines.filter((one) => one.topic === topic).length >= (topic.maxMessages ?? most)}
            onClick={() => change([...lines, newLine(topic, next())])}>
            {texts.addAnother} <Strange text={topic.title || topic.topic} most={60} />
          </button>
        ))}
      </p>
    </div>
  );
}

function EntryInput(props: { schema: ValueSchema; entry: Entry; label: string; needed: boolean; change: (entry: Entry) => void }) {
  const { schema, entry, change, needed } = props;
  const label = <><Strange text={schema.title || props.label} most={80} />{schema.unit ? <span class="quiet"> ({schema.unit})</span> : null}</>;
  const hint = schema.description ? <Strange text={schema.description} /> : undefined;
  if (schema.type === "null") return <p class="quiet">{texts.noValue}</p>;
  if (schema.type === "object") {
    const fields = entry as Record<string, Entry>;
    return (
      <div class="fields">
        {Object.entries(schema.properties ?? {}).map(([name, field]) => (
          <EntryInput key={name} schema={field} label={name} entry={fields[name]} needed={schema.required?.includes(name) ?? false} change={(inner) => change({ ...fields, [name]: inner })} />
        ))}
      </div>
    );
  }
  if (schema.type === "array") return <ArrayInput schema={schema} items={entry as Entry[]} label={props.label} change={change} />;
  if (schema.type === "boolean") {
    return <Field label={label} hint={hint}>{(id, about) => <input id={id} aria-describedby={about} type="checkbox" checked={entry as boolean} onChange={(event) => change(event.currentTarget.checked)} />}</Field>;
  }
  if (schema.enum?.length) {
    return (
      <Field label={label} hint={hint}>
        {(id, about) => (
          <select id={id} aria-describedby={about} class="big" value={entry as string} onChange={(event) => change(event.currentTarget.value)}>
            {schema.enum!.map((one, place) => <option key={place} value={String(place)}>{String(one)}</option>)}
          </select>
        )}
      </Field>
    );
  }
  const text = entry as string;
  const fault = readEntry(schema, text, needed).fault;
  if (schema.type === "integer" || schema.type === "number") {
    const isPositive = (schema.minimum ?? schema.exclusiveMinimum ?? -1) >= 0;
    return <NumberField label={label} text={text} change={change} error={fault} hint={hint ?? rangeWords(schema)} class="big number" signed={!isPositive} />;
  }
  if (!schema.type) {
    return <Field label={label} error={fault} hint={hint ?? texts.jsonHint}>{(id, about) => <textarea id={id} aria-describedby={about} rows={3} value={text} onInput={(event) => change(event.currentTarget.value)} />}</Field>;
  }
  return (
    <Field label={label} error={fault} hint={hint ?? (schema.contentEncoding ? texts.base64 : undefined)}>
      {(id, about) => <input id={id} aria-describedby={about} class="big" value={text} onInput={(event) => change(event.currentTarget.value)} />}
    </Field>
  );
}

function ArrayInput(props: { schema: ValueSchema; items: Entry[]; label: string; change: (items: Entry[]) => void }) {
  const { schema, items, label, change } = props;
  const inner = schema.items ?? {};
  return (
    <div class="list">
      {items.map((item, place) => (
        <EntryInput key={place} schema={inner} label={`${schema.title || label} ${place + 1}`} entry={item} needed
          change={(changed) => change(items.map((one, at) => (at === place ? changed : one)))} />
      ))}
      <p class="row">
        <button type="button" class="button small quietly" disabled={items.length >= (schema.maxItems ?? 64)} onClick={() => change([...items, initialEntry(inner)])}>{texts.addOne}</button>
        <button type="button" class="button small quietly" disabled={items.length <= (schema.minItems ?? 0)} onClick={() => change(items.slice(0, -1))}>{texts.remove}</button>
      </p>
    </div>
  );
}
