// What a form of a model's description holds, as it is typed, and the JSON that it means.

import { compare, decimalText, encodeJson, parseDecimal } from "./numbers";
import { texts } from "./texts";
import type { ValueSchema } from "./types";

/** The content of a field as it stands there (of a choice: its place in the list), or of the fields inside. */
export type Entry = string | boolean | Entry[] | { [name: string]: Entry };

/** The JSON that an entry means, undefined if the field is left out; or what is wrong with it. */
export type Reading = { json?: string; fault?: undefined } | { fault: string };

export function initialEntry(schema: ValueSchema): Entry {
  const { type, minimum, maximum } = schema;
  const given = schema.default ?? undefined;
  if (schema.enum?.length) return String(Math.max(0, schema.enum.indexOf(given as string)));
  if (type === "boolean") return given === true;
  if (type === "object") return Object.fromEntries(Object.entries(schema.properties ?? {}).map(([name, field]) => [name, initialEntry(field)]));
  if (type === "array") return Array.from({ length: schema.minItems ?? 0 }, () => initialEntry(schema.items ?? {}));
  if (given !== undefined) return type ? String(given) : JSON.stringify(given);
  return type === "integer" || type === "number" ? String(minimum ?? Math.min(0, maximum ?? 0)) : "";
}

/** Reads an entry. A field that is not `needed` may be empty, and is left out then. */
export function readEntry(schema: ValueSchema, entry: Entry, needed = true): Reading {
  if (schema.type === "null") return { json: "null" };
  if (schema.type === "boolean") return { json: String(entry) };
  if (schema.enum?.length) return { json: encodeJson(schema.enum[Number(entry)]) };
  if (schema.type === "object") {
    const read = Object.entries(schema.properties ?? {}).map(([name, field]) => [name, readEntry(field, (entry as Record<string, Entry>)[name], schema.required?.includes(name) ?? false)] as const);
    return joined(read.map(([, one]) => one), (parts) => `{${parts.map((json, place) => json === undefined ? "" : `${JSON.stringify(read[place][0])}:${json}`).filter(Boolean).join(",")}}`);
  }
  if (schema.type === "array") return joined((entry as Entry[]).map((one) => readEntry(schema.items ?? {}, one)), (parts) => `[${parts.join(",")}]`);
  const text = entry as string;
  if (schema.type === "integer" || schema.type === "number") return readNumber(schema, text, needed);
  return schema.type ? readText(schema, text) : readJson(text, needed);
}

function joined(read: Reading[], join: (parts: (string | undefined)[]) => string): Reading {
  const wrong = read.find((one) => one.fault !== undefined);
  return wrong ?? { json: join(read.map((one) => (one as { json?: string }).json)) };
}

/** The values that a number may have, in words; empty if any. */
export function rangeWords(schema: ValueSchema): string {
  const limits = [
    schema.minimum === undefined ? "" : texts.atLeast(schema.minimum),
    schema.exclusiveMinimum === undefined ? "" : texts.moreThan(schema.exclusiveMinimum),
    schema.maximum === undefined ? "" : texts.atMost(schema.maximum),
    schema.exclusiveMaximum === undefined ? "" : texts.lessThan(schema.exclusiveMaximum),
  ];
  return limits.filter(Boolean).join(", ");
}

export function readNumber(schema: ValueSchema, text: string, needed = true): Reading {
  if (text.trim() === "") return needed ? { fault: texts.fillIn } : {};
  const number = parseDecimal(text);
  const written = number && decimalText(number);
  if (number === null || written === null) return { fault: texts.notANumber };
  if (schema.type === "integer" && number.scale > 0) return { fault: texts.notWhole };
  const beyond = (limit: number | undefined) => (limit === undefined ? null : compare(number, parseDecimal(String(limit))!));
  const [least, above, most, below] = [schema.minimum, schema.exclusiveMinimum, schema.maximum, schema.exclusiveMaximum].map(beyond);
  const isOutside = (least ?? 0) < 0 || (above ?? 1) <= 0 || (most ?? 0) > 0 || (below ?? -1) >= 0;
  if (isOutside) return { fault: rangeWords(schema) };
  if (schema.type === "integer" || number.scale === 0 && written.length < 80) return { json: written };
  const float = Number(written);
  return !Number.isFinite(float) || (float === 0 && number.digits !== 0n) ? { fault: texts.notANumber } : { json: String(float) };
}

function readText(schema: ValueSchema, text: string): Reading {
  const length = [...text].length;
  if (length < (schema.minLength ?? 0) || length > (schema.maxLength ?? Infinity)) return { fault: texts.characters(schema.minLength ?? 0, schema.maxLength) };
  if (schema.contentEncoding && (text.length % 4 || !/^[A-Za-z0-9+/]*={0,2}$/.test(text))) return { fault: texts.notBase64 };
  return { json: JSON.stringify(text) };
}

function readJson(text: string, needed: boolean): Reading {
  if (text.trim() === "") return needed ? { json: "null" } : {};
  try {
    JSON.parse(text);
    return { json: text };
  } catch {
    return { fault: texts.notJson };
  }
}

/** A decoded value as rows of a name and words, as its description calls them. */
export function inWords(schema: ValueSchema, value: unknown, name: string): [string, string][] {
  const title = `${schema.title || name}`;
  if (typeof value === "object" && value !== null && !Array.isArray(value)) {
    const fields = value as Record<string, unknown>;
    if (schema.type !== "object" && Object.keys(fields).join() === "data") return inWords(schema, fields.data, name);
    return Object.entries(fields).flatMap(([key, one]) => inWords(schema.properties?.[key] ?? {}, one, key));
  }
  if (Array.isArray(value) && value.some((one) => typeof one === "object" && one !== null)) {
    return value.flatMap((one, place) => inWords(schema.items ?? {}, one, `${title} ${place + 1}`).map(([key, words]) => [`${title} ${place + 1}: ${key}`, words] as [string, string]));
  }
  if (value === null || value === undefined) return [[title, texts.none]];
  const words = Array.isArray(value) ? value.map(String).join(", ") : value === true ? texts.yes : value === false ? texts.no : String(value);
  const unit = schema.unit ?? schema.items?.unit;
  return [[title, unit ? `${words} ${unit}` : words]];
}
