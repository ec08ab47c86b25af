import assert from "node:assert/strict";
import test from "node:test";
import { decimalText, encodeJson, parseAmount, parseDecimal, parseExact } from "../src/numbers";
import { inWords, initialEntry, readEntry } from "../src/values";

const LARGEST = String(2n ** 256n - 1n);
const read = (text: string) => {
  const number = parseDecimal(text);
  return number && decimalText(number);
};

test("a text means the number that people write with it", () => {
  const meant: Record<string, string> = {
    "2.5": "2.5", "0.25": "0.25", "1.05": "1.05", "2,5": "2.5", "0,125": "0.125", "2.": "2", ".5": "0.5", "-.5": "-0.5", "−3": "-3", "+7": "7", "007": "7",
    "2.50": "2.5", "1e3": "1000", "1.5e-3": "0.0015", "1 000 000.5": "1000000.5", "1\u00a0000": "1000", " 5 ": "5", "-0": "0", "0.0": "0", [LARGEST]: LARGEST,
  };
  for (const [text, number] of Object.entries(meant)) assert.equal(read(text), number, text);
});

test("a text that means no number, or may mean two, is refused", () => {
  for (const text of ["", "-", ".", "e3", "1e", "1.2.3", "1,000", "1,000.5", "1.000,5", "0x10", "NaN", "Infinity", "1 2", "1_000", "5 m", "1e9999", "9".repeat(101)]) {
    assert.equal(parseDecimal(text), null, text);
  }
});

test("an amount is exact to the last unit, and never more than a contract holds", () => {
  assert.equal(parseAmount("0.000000001", 9), 1n);
  assert.equal(parseAmount("12345678901234567890.123456789", 9), 12345678901234567890123456789n);
  assert.equal(parseAmount(LARGEST, 0), 2n ** 256n - 1n);
  for (const [text, decimals] of [["1e-10", 9], ["-1", 9], [String(2n ** 256n), 0], ["1.5", 0]] as const) assert.equal(parseAmount(text, decimals), null, text);
});

test("integers beyond a number's precision pass JSON", () => {
  const json = `{"id":${LARGEST},"neg":-9223372036854775809,"text":"12345678901234567890","real":0.123456789012345,"list":[9007199254740993,1]}`;
  assert.equal(encodeJson(parseExact(json)), json);
  assert.equal(parseExact(`"\\u0000x"`), "\u0000x");
});

test("entries are read as their description says", () => {
  const json = (schema: any, text: any, needed = true) => readEntry(schema, text, needed).json;
  assert.equal(json({ type: "integer" }, "18446744073709551615"), "18446744073709551615");
  assert.equal(json({ type: "number" }, "2,50"), "2.5");
  assert.equal(json({ type: "integer" }, "1e3"), "1000");
  for (const [schema, text] of [
    [{ type: "integer" }, "1.5"], [{ type: "number" }, ""], [{ type: "number", minimum: 0.5 }, "0.4999999999999999999999"], [{ type: "number", exclusiveMinimum: 0 }, "0"],
    [{ type: "integer", maximum: 10 }, "11"], [{ type: "number", exclusiveMaximum: 1 }, "1"], [{ type: "number" }, "1e-400"], [{}, "{"], [{ type: "string", minLength: 2 }, "a"],
  ] as const) assert.ok(readEntry(schema as any, text).fault, JSON.stringify([schema, text]));
  const schema = { type: "object", properties: { a: { type: "number" }, b: { type: "integer" }, c: { enum: ["x", "y"], type: "string" } }, required: ["a"] };
  assert.equal(json(schema, { a: "1.05", b: "", c: "1" }), `{"a":1.05,"c":"y"}`);
  assert.equal(json({}, `{"id": 18446744073709551615}`), `{"id": 18446744073709551615}`);
  assert.deepEqual(initialEntry({ type: "object", properties: { a: { type: "number", default: 0.25 }, b: { type: "boolean" } } }), { a: "0.25", b: false });
});

test("values are told in the words of the description", () => {
  const schema = { type: "object", properties: { angle: { type: "integer", title: "Angle", unit: "°" }, on: { type: "boolean" } } };
  assert.deepEqual(inWords(schema, { angle: 170, on: true, extra: 2n ** 64n }, "Turn"), [["Angle", "170 °"], ["on", "yes"], ["extra", "18446744073709551616"]]);
  assert.deepEqual(inWords({ type: "string", title: "Lamp" }, { data: "red" }, "x"), [["Lamp", "red"]]);
});
