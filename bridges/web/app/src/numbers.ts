// Numbers as people type them. A field keeps its text; the number is read from it, exactly, when it is used.

/** `digits` / 10^`scale`, without zeros at the end of a fraction. */
export interface Decimal {
  digits: bigint;
  scale: number;
}

const LONGEST = 100;
const MOST_UNITS = 2n ** 256n;

/**
 * The number that a text means; null if it means none, or may mean two.
 *
 * A comma is a decimal point, and blanks may stand between thousands. "1,234" is refused: it is one and a bit to some
 * people and a thousand to others.
 */
export function parseDecimal(text: string): Decimal | null {
  const number = text.trim().replace(/^−/, "-").replace(/(?<=\d)[\s'’](?=\d{3}(?!\d))/g, "");
  const [all, sign, whole, part = "", exponent = "0"] = /^([+-]?)(\d*)(?:[.,](\d*))?(?:e([+-]?\d{1,3}))?$/i.exec(number) ?? [];
  if (all === undefined || all.length > LONGEST || whole + part === "" || /^[+-]?[1-9]\d{0,2},\d{3}$/.test(number)) return null;
  let digits = BigInt(sign === "-" ? `-${whole + part}` : whole + part);
  let scale = part.length - Number(exponent);
  for (; scale > 0 && digits % 10n === 0n; scale--) digits /= 10n;
  if (scale < 0) [digits, scale] = [digits * 10n ** BigInt(-scale), 0];
  return { digits, scale };
}

export function decimalText({ digits, scale }: Decimal): string {
  const all = String(digits < 0n ? -digits : digits).padStart(scale + 1, "0");
  const whole = all.slice(0, all.length - scale);
  return `${digits < 0n ? "-" : ""}${whole}${scale ? `.${all.slice(-scale)}` : ""}`;
}

/** Below 0 if `one` is less than `other`, 0 if they are equal. */
export function compare(one: Decimal, other: Decimal): number {
  const difference = one.digits * 10n ** BigInt(other.scale) - other.digits * 10n ** BigInt(one.scale);
  return difference < 0n ? -1 : difference > 0n ? 1 : 0;
}

/** The units that a person's number means; null if it is none, negative, finer than the token, or more than contracts hold. */
export function parseAmount(text: string, decimals: number): bigint | null {
  const number = parseDecimal(text);
  if (number === null || number.digits < 0n || number.scale > decimals) return null;
  const units = number.digits * 10n ** BigInt(decimals - number.scale);
  return units < MOST_UNITS ? units : null;
}

/** What JSON says, with integers that a JavaScript number can't hold as bigint. */
export function parseExact(json: string): any {
  const exact = json.replace(/"(?:[^"\\]|\\.)*"|-?\d{16,}(?![\d.eE])/g, (found, at) =>
    found[0] === '"' || /[\d.eE+-]/.test(json[at - 1] ?? "") || Number.isSafeInteger(Number(found)) ? found : `"\\u0000${found}"`);
  return JSON.parse(exact, (_, value) => (typeof value === "string" && /^\0-?\d+$/.test(value) ? BigInt(value.slice(1)) : value));
}

/** JSON, with bigints as integers of any length. */
export function encodeJson(value: unknown): string {
  if (typeof value === "bigint") return String(value);
  if (Array.isArray(value)) return `[${value.map(encodeJson).join(",")}]`;
  if (typeof value !== "object" || value === null) return JSON.stringify(value);
  const fields = Object.entries(value).filter(([, one]) => one !== undefined);
  return `{${fields.map(([name, one]) => `${JSON.stringify(name)}:${encodeJson(one)}`).join(",")}}`;
}
