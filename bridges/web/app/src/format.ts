// Numbers, times and the texts of strangers, for people.

import { formatUnits } from "viem";
import { encodeJson } from "./numbers";
import type { Token } from "./types";

/** Controls, and the signs that turn or hide letters: a stranger's text must not change what stands around it. */
const INVISIBLE = /[\u0000-\u0008\u000b-\u001f\u007f-\u009f\u200b-\u200f\u202a-\u202e\u2060-\u206f\ufeff]/g;

/** A stranger's text, cut and without invisible signs. */
export function plain(text: string, most = 400): string {
  const visible = text.replace(INVISIBLE, "�");
  return visible.length > most ? `${visible.slice(0, most)}…` : visible;
}

export function amount(units: string | bigint, token: Token): string {
  return `${grouped(formatUnits(BigInt(units), token.decimals))} ${plain(token.symbol, 32)}`;
}

export function ether(wei: string | bigint): string {
  if (BigInt(wei) > 0n && BigInt(wei) < 10n ** 6n) return `${grouped(String(wei))} wei`;
  if (BigInt(wei) > 0n && BigInt(wei) < 10n ** 14n) return `${Number(formatUnits(BigInt(wei), 9)).toLocaleString("en", { maximumSignificantDigits: 3 })} gwei`;
  const [whole, part = ""] = formatUnits(BigInt(wei), 18).split(".");
  return `${grouped(part ? `${whole}.${part.slice(0, 5)}` : whole)} ETH`;
}

export function grouped(number: string): string {
  const [whole, part] = number.split(".");
  return whole.replace(/\B(?=(\d{3})+$)/g, " ") + (part ? `.${part}` : "");
}

export function short(text: string): string {
  return text.length > 16 ? `${text.slice(0, 6)}…${text.slice(-4)}` : text;
}

export function size(bytes: number): string {
  const units = ["B", "KiB", "MiB", "GiB", "TiB"];
  let unit = 0;
  for (; bytes >= 1024 && unit < units.length - 1; unit++) bytes /= 1024;
  return `${bytes >= 100 || unit === 0 ? Math.round(bytes) : bytes.toFixed(1)} ${units[unit]}`;
}

export function duration(seconds: number): string {
  if (seconds < 1) return `${Math.round(seconds * 1000)} ms`;
  if (seconds < 90) return `${Number(seconds.toFixed(1))} s`;
  if (seconds < 5400) return `${Math.round(seconds / 60)} min`;
  if (seconds < 172_800) return `${Number((seconds / 3600).toFixed(1))} h`;
  return `${Math.round(seconds / 86_400)} d`;
}

export function clock(at: number): string {
  const time = new Date(at * 1000);
  const today = time.toDateString() === new Date().toDateString();
  const options: Intl.DateTimeFormatOptions = { hour: "2-digit", minute: "2-digit", second: "2-digit" };
  return time.toLocaleString(undefined, today ? options : { ...options, day: "numeric", month: "short", year: "numeric" });
}

/** A time in the past, to the minute. */
export function since(at: number): string {
  const time = new Date(at * 1000);
  const day: Intl.DateTimeFormatOptions = time.toDateString() === new Date().toDateString() ? {} : { day: "numeric", month: "short" };
  return time.toLocaleString(undefined, { hour: "2-digit", minute: "2-digit", ...day });
}

/** A decoded value in one line. */
export function shown(value: unknown): string {
  return plain(typeof value === "string" ? value : encodeJson(value) ?? "", 600);
}
