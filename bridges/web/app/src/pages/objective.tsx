import { useState } from "preact/hooks";
import { get, post, postFile, query } from "../api";
import { useApp, wordsOf } from "../app";
import { isCid } from "../cid";
import { duration, size } from "../format";
import { texts } from "../texts";
import { checkUpload } from "../trust";
import type { Model, ModelTopic, Objective, Summary, ValueSchema } from "../types";
import { Action, Badge, Field, Name, Strange } from "../ui";

interface Choice {
  model: Model;
  objective: Objective | null;
  choose: (objective: Objective) => void;
}

/** Three ways to an objective: a form made from the model's description, a file, a CID. */
export function ObjectiveChoice(props: Choice) {
  const described = props.model.description?.objective ?? [];
  const ways = described.length ? (["form", "file", "cid"] as const) : (["file", "cid", "none"] as const);
  const [way, setWay] = useState<string>(ways[0]);
  const [error, setError] = useState("");
  const attempt = (find: () => Promise<Objective>) => async () => {
    setError("");
    props.choose(await find());
  };
  const onError = (problem: unknown) => setError(wordsOf(problem));
  return (
    <>
      <div class="tabs" role="tablist" aria-label={texts.chooseObjective}>
        {ways.map((one) => (
          <button key={one} id={`way-${one}`} type="button" role="tab" aria-selected={way === one} class="tab" onClick={() => setWay(one)}>{texts.ways[one]}</button>
        ))}
      </div>
      {way === "form" ? <DescribedForm model={props.model} attempt={attempt} onError={onError} /> : null}
      {way === "file" ? <FileChoice model={props.model} attempt={attempt} onError={onError} /> : null}
      {way === "cid" ? <CidChoice model={props.model} attempt={attempt} onError={onError} /> : null}
      {way === "none" ? (
        <>
          <p class="hint">{texts.noObjectiveHint}</p>
          <button type="button" id="no-objective" class="button" onClick={() => props.choose(noObjective(props.model.cid))}>{texts.noObjective}</button>
        </>
      ) : null}
      {error ? <p class="problem" role="alert">{error}</p> : null}
      {props.objective?.cid === props.model.cid ? <p class="chosen-objective">{texts.withoutObjective}</p> : props.objective ? <Chosen objective={props.objective} described={props.model.described} /> : null}
    </>
  );
}

/** Robots that need no objective, such as sensors, are ordered by naming the model in its place. Nobody need have its file. */
function noObjective(model: string): Objective {
  const summary = { cid: model, format: "", size: 0, messages: 0, startNs: "0", durationNs: "0", topics: [], metadata: {}, attachments: [] };
  return { cid: model, size: 0, summary, preflight: { ok: true, reason: "", detail: "" } };
}

interface Way {
  model: Model;
  attempt: (find: () => Promise<Objective>) => () => Promise<void>;
  onError: (problem: unknown) => void;
}

function Chosen({ objective, described }: { objective: Objective; described: boolean }) {
  const { summary, preflight } = objective;
  return (
    <div class="chosen-objective">
      <p>
        <Badge kind={!preflight.ok ? "bad" : described ? "good" : "calm"}>{!preflight.ok ? texts.fitsNot : described ? texts.fits : texts.unchecked}</Badge>{" "}
        <Name text={objective.cid} /> {texts.objectiveSummary(summary.messages, summary.durationNs === "0" ? "" : duration(Number(summary.durationNs) / 1e9), size(summary.size))}
      </p>
      {preflight.ok ? null : <p class="problem" role="alert"><Strange text={preflight.detail} /> <code>{preflight.reason}</code></p>}
      <ul class="inline">{summary.topics.slice(0, 12).map((topic) => <li key={topic.topic}><code><Strange text={topic.topic} most={60} /></code> {topic.messages}×</li>)}</ul>
    </div>
  );
}

function FileChoice({ model, attempt, onError }: Way) {
  const { market } = useApp();
  const [file, setFile] = useState<File | null>(null);
  const send = attempt(async () => {
    const objective = await postFile<Objective>(`objectives${query({ model: model.cid })}`, file!);
    await checkUpload(new Uint8Array(await file!.arrayBuffer()), objective.cid);
    return objective;
  });
  const tooLarge = file !== null && file.size > market.limits.upload;
  return (
    <>
      <Field label={texts.file} hint={texts.fileHint(size(market.limits.upload))} error={tooLarge ? texts.fileTooLarge : ""}>
        {(id, described) => <input id={id} aria-describedby={described} type="file" accept=".mcap,.bag" onChange={(event) => setFile(event.currentTarget.files?.[0] ?? null)} />}
      </Field>
      <Action id="upload" disabled={!file || tooLarge} run={send} onError={onError}>{texts.upload}</Action>
    </>
  );
}

function CidChoice({ model, attempt, onError }: Way) {
  const [cid, setCid] = useState("");
  const find = attempt(async () => {
    const [summary, preflight] = await Promise.all([
      get<Summary>(`files/${cid}/summary`),
      model.described ? get<Objective["preflight"]>(`files/${cid}/preflight${query({ model: model.cid })}`) : { ok: true, reason: "", detail: "" },
    ]);
    return { cid, size: summary.size, summary, preflight };
  });
  return (
    <>
      <Field label={texts.objectiveCid} error={cid && !isCid(cid) ? texts.notACid : ""} hint={texts.objectiveCidHint}>
        {(id, described) => <input id={id} aria-describedby={described} class="wide" spellcheck={false} value={cid} onInput={(event) => setCid(event.currentTarget.value.trim())} />}
      </Field>
      <Action id="take-cid" disabled={!isCid(cid)} run={find} onError={onError}>{texts.take}</Action>
    </>
  );
}

interface Line {
  topic: ModelTopic;
  value: unknown;
  at: number;
}

/** A form of messages, as the model describes them: each line is a message on a topic at a time. */
function DescribedForm({ model, attempt, onError }: Way) {
  const topics = model.description!.objective!;
  const most = model.description!.limits?.messages ?? 200;
  const line = (topic: ModelTopic, at: number): Line => ({ topic, at, value: initial(topic.value ?? {}) });
  const [lines, setLines] = useState<Line[]>(() => {
    const required = topics.filter((topic) => topic.required);
    return (required.length ? required : topics.slice(0, 1)).map((topic) => line(topic, 0));
  });
  const change = (place: number, fields: Partial<Line>) => setLines((known) => known.map((one, at) => (at === place ? { ...one, ...fields } : one)));
  const send = attempt(() =>
    post<Objective>("objectives/form", { model: model.cid, values: lines.map(({ topic, value, at }) => ({ topic: topic.topic, value, at })) }),
  );
  return (
    <div class="form">
      {lines.map((one, place) => (
        <fieldset key={place}>
          <legend><Strange text={one.topic.title || one.topic.topic} most={80} /> {lines.length > 1 ? `· ${place + 1}` : ""}</legend>
          {one.topic.description ? <p class="hint"><Strange text={one.topic.description} /></p> : null}
          <ValueInput schema={one.topic.value ?? {}} value={one.value} label={one.topic.value?.title || one.topic.title || texts.value} change={(value) => change(place, { value })} />
          {lines.length > 1 ? (
            <div class="row end">
              <Field label={texts.atSecond}>
                {(id) => <input id={id} type="number" min={0} step="any" class="narrow" value={one.at} onInput={(event) => change(place, { at: Math.max(0, Number(event.currentTarget.value)) })} />}
              </Field>
              <button type="button" class="button small quietly" onClick={() => setLines((known) => known.filter((_, at) => at !== place))}>{texts.remove}</button>
            </div>
          ) : null}
        </fieldset>
      ))}
      <p class="row">
        {topics.map((topic) => (
          <button key={topic.topic} type="button" class="button small quietly" disabled={lines.length >= most || lines.filter((one) => one.topic === topic).length >= (topic.maxMessages ?? most)}
            onClick={() => setLines((known) => [...known, line(topic, (known.at(-1)?.at ?? -1) + 1)])}>
            {texts.addAnother} <Strange text={topic.title || topic.topic} most={60} />
          </button>
        ))}
      </p>
      <Action id="make" disabled={!lines.length} run={send} onError={onError}>{texts.makeObjective}</Action>
    </div>
  );
}

function initial(schema: ValueSchema): unknown {
  if (schema.default !== undefined && schema.default !== null) return schema.default;
  if (schema.enum?.length) return schema.enum[0];
  if (schema.type === "boolean") return false;
  if (schema.type === "integer" || schema.type === "number") return schema.minimum ?? Math.min(0, schema.maximum ?? 0);
  if (schema.type === "string") return "";
  if (schema.type === "array") return Array.from({ length: schema.minItems ?? 0 }, () => initial(schema.items ?? {}));
  if (schema.type === "object") return Object.fromEntries(Object.entries(schema.properties ?? {}).map(([name, field]) => [name, initial(field)]));
  return schema.type === "null" ? null : "";
}

function ValueInput(props: { schema: ValueSchema; value: any; label: string; change: (value: unknown) => void }) {
  const { schema, value, change } = props;
  const label = <><Strange text={schema.title || props.label} most={80} />{schema.unit ? <span class="quiet"> ({schema.unit})</span> : null}</>;
  const hint = schema.description ? <Strange text={schema.description} /> : undefined;
  if (schema.type === "null") return <p class="quiet">{texts.noValue}</p>;
  if (schema.type === "object") {
    return (
      <div class="fields">
        {Object.entries(schema.properties ?? {}).map(([name, field]) => (
          <ValueInput key={name} schema={field} label={name} value={value?.[name]} change={(inner) => change({ ...value, [name]: inner })} />
        ))}
      </div>
    );
  }
  if (schema.type === "array") return <ArrayInput {...props} />;
  if (schema.type === "boolean") {
    return <Field label={label} hint={hint}>{(id, described) => <input id={id} aria-describedby={described} type="checkbox" checked={Boolean(value)} onChange={(event) => change(event.currentTarget.checked)} />}</Field>;
  }
  if (schema.enum?.length) {
    return (
      <Field label={label} hint={hint}>
        {(id, described) => (
          <select id={id} aria-describedby={described} class="big" value={String(value)} onChange={(event) => change(schema.enum![event.currentTarget.selectedIndex])}>
            {schema.enum!.map((one) => <option key={String(one)} value={String(one)}>{String(one)}</option>)}
          </select>
        )}
      </Field>
    );
  }
  if (schema.type === "integer" || schema.type === "number") return <NumberInput {...props} label={label} hint={hint} />;
  if (!schema.type) return <JsonInput {...props} label={label} hint={hint} />;
  return (
    <Field label={label} hint={hint ?? (schema.contentEncoding ? texts.base64 : undefined)}>
      {(id, described) => <input id={id} aria-describedby={described} class="big" minLength={schema.minLength} maxLength={schema.maxLength} value={String(value ?? "")} onInput={(event) => change(event.currentTarget.value)} />}
    </Field>
  );
}

function NumberInput({ schema, value, label, hint, change }: { schema: ValueSchema; value: any; label: any; hint: any; change: (value: unknown) => void }) {
  const least = schema.minimum ?? schema.exclusiveMinimum;
  const most = schema.maximum ?? schema.exclusiveMaximum;
  const range = least !== undefined || most !== undefined ? texts.range(least, most) : undefined;
  return (
    <Field label={label} hint={hint ?? range}>
      {(id, described) => (
        <input id={id} aria-describedby={described} type="number" class="big number" min={least} max={most} step={schema.type === "integer" ? 1 : "any"} value={value}
          onInput={(event) => change(event.currentTarget.value === "" ? null : Number(event.currentTarget.value))} />
      )}
    </Field>
  );
}

function JsonInput({ value, label, change }: { value: any; label: any; hint: any; change: (value: unknown) => void }) {
  const [text, setText] = useState(() => (value === "" ? "" : JSON.stringify(value)));
  const [wrong, setWrong] = useState(false);
  const read = (given: string) => {
    setText(given);
    try {
      change(given.trim() === "" ? null : JSON.parse(given));
      setWrong(false);
    } catch {
      setWrong(true);
    }
  };
  return (
    <Field label={label} error={wrong ? texts.notJson : ""} hint={texts.jsonHint}>
      {(id, described) => <textarea id={id} aria-describedby={described} rows={3} value={text} onInput={(event) => read(event.currentTarget.value)} />}
    </Field>
  );
}

function ArrayInput({ schema, value, label, change }: { schema: ValueSchema; value: any; label: string; change: (value: unknown) => void }) {
  const items: unknown[] = Array.isArray(value) ? value : [];
  return (
    <div class="list">
      {items.map((item, place) => (
        <ValueInput key={place} schema={schema.items ?? {}} label={`${schema.title || label} ${place + 1}`} value={item}
          change={(inner) => change(items.map((one, at) => (at === place ? inner : one)))} />
      ))}
      <p class="row">
        <button type="button" class="button small quietly" disabled={items.length >= (schema.maxItems ?? 64)} onClick={() => change([...items, initial(schema.items ?? {})])}>{texts.addOne}</button>
        <button type="button" class="button small quietly" disabled={items.length <= (schema.minItems ?? 0)} onClick={() => change(items.slice(0, -1))}>{texts.remove}</button>
      </p>
    </div>
  );
}
