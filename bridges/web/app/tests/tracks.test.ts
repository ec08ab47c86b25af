import assert from "node:assert/strict";
import test from "node:test";
import { Gathered, MOST_COLUMNS, MOST_MESSAGES, MOST_POINTS, MOST_TRACKS, elapsed, figure, gather, inOrder, latest, placeAt, placesOf, roundLength, statesOf, tickText, viewOf, withoutNumbers } from "../src/tracks";
import type { Sample } from "../src/tracks";

const sample = (topic: string, at: number, numbers: Sample["numbers"], more: Partial<Sample> = {}): Sample =>
  ({ topic, role: "device", at, value: null, numbers, image: null, size: 1, cut: false, ...more });
const only = (samples: Sample[]) => gather(samples).tracks[0];

test("samples become columns by topic and role, with holes where a message had no such number", () => {
  const { tracks } = gather([
    sample("/a", 1, [[".x", 1]]), sample("/a", 2, [["x", 2], ["y", 5]]), sample("/a", 3, [["y", 6]]), sample("/a", 1, [["x", 9]], { role: "objective" }),
  ]);
  assert.deepEqual(tracks.map((track) => [track.topic, track.role, track.count]), [["/a", "device", 3], ["/a", "objective", 1]]);
  assert.deepEqual(tracks[0].at, [1, 2, 3]);
  assert.deepEqual(tracks[0].columns, [{ name: "x", values: [1, 2, null] }, { name: "y", values: [null, 5, 6] }]);
});

test("a name that a message has twice counts once", () => {
  assert.deepEqual(only([sample("/a", 1, [["x", 1], [".x", 2]]), sample("/a", 2, [["x", 3]])]).columns, [{ name: "x", values: [1, 3] }]);
});

test("times of what is live count from the first sample, and an older one is left out", () => {
  const track = only([sample("/a", 1_700_000_000, [["", 1]]), sample("/a", 1_700_000_002.5, [["", 2]]), sample("/a", 1_700_000_001, [["", 3]]), sample("/a", NaN, [["", 4]])]);
  assert.deepEqual(track.at, [0, 2.5]);
});

test("memory is bounded, and the whole time stays in view, finer where it is new", () => {
  const gathered = new Gathered();
  for (let at = 0; at < 20_000; at++) gathered.add(sample("/fast", at, [["", at]]));
  const [track] = gathered.tracks;
  assert.equal(track.count, 20_000);
  assert.ok(track.at.length <= MOST_POINTS && track.messages.length <= 2 * MOST_MESSAGES);
  assert.equal(track.columns[0].values.length, track.at.length);
  assert.deepEqual(track.columns[0].values, track.at);
  assert.ok(track.at[0] === 0 && track.at.at(-1) === 19_999 && track.at.at(-2) === 19_998);
  for (let number = 0; number < 2 * MOST_TRACKS; number++) gathered.add(sample(`/${number}`, 1, [["", 1]]));
  assert.equal(gathered.tracks.length, MOST_TRACKS);
  assert.equal(only([sample("/wide", 0, Array.from({ length: 500 }, (_, place) => [`[${place}]`, 1]))]).columns.length, MOST_COLUMNS);
});

test("of live pictures the last is kept, of a recording's all; what is no picture of this server is none", () => {
  const live = "data:image/png;base64,AA==";
  assert.equal(only([1, 2, 3].map((at) => sample("/camera", at, [], { image: live }))).pictures.length, 1);
  const recorded = only([1, 2, 3].map((at) => sample("/camera", at, [], { image: `/api/v1/files/Qm/images/${at}` })));
  assert.equal(latest(recorded.pictures, 2.5)?.image, "/api/v1/files/Qm/images/2");
  assert.equal(latest(recorded.pictures, 0.5), undefined);
  for (const image of ["https://evil.example/a.png", "data:image/svg+xml;base64,AA==", "javascript:1"]) assert.deepEqual(only([sample("/camera", 1, [], { image })]).pictures, []);
});

test("titles and units are those of the description, and each plot has one unit", () => {
  const value = { type: "object", properties: { percent: { type: "number", title: "Charge", unit: "%" }, volts: { type: "number", title: "Voltage", unit: "V" }, on: { type: "boolean" }, arm: { type: "array", title: "Joint", items: { type: "number", unit: "°" } } } };
  const model = { title: "", result: [{ topic: "/battery", title: "Battery", value }] };
  const track = only([sample("/battery", 1, [[".percent", 1], [".volts", 2], [".on", 1], [".arm[0]", 3], [".arm[1]", 4]])]);
  const view = viewOf(track, model);
  assert.equal(view.title, "Battery");
  assert.deepEqual(view.plots.map((plot) => plot.map((one) => [one.title, one.unit, one.isBoolean])), [
    [["Charge", "%", false]], [["Voltage", "V", false]], [["on", "", true]], [["Joint 1", "°", false], ["Joint 2", "°", false]],
  ]);
  const lone = only([sample("/driven", 1, [["data", 1]])]);
  assert.deepEqual(viewOf(lone, { title: "", result: [{ topic: "/driven", value: { type: "number", title: "Distance", unit: "m" } }] }).plots[0][0], { name: "data", title: "Distance", unit: "m", isBoolean: false });
  assert.deepEqual([viewOf(lone, null).title, viewOf(only([sample("/arm/left_grip", 1, [])]), null).title, viewOf(only([sample("", 1, []), ]), null).title], ["Driven", "Arm left grip", ""]);
});

test("what moves on a plane or on the earth is a path; what only has an x and a y is none", () => {
  const path = (...names: string[]) => viewOf(only([1, 2].map((at) => sample("/a", at, names.map((name) => [name, at])))), null).position;
  assert.deepEqual([path("x", "y", "theta")?.angle, path(".pose.pose.position.x", ".pose.pose.position.y")?.x], ["theta", "pose.pose.position.x"]);
  assert.deepEqual([path("latitude", "longitude", "altitude")?.onEarth, path("lat", "lon")?.onEarth], [true, true]);
  for (const names of [["x"], ["linear.x", "linear.y"], ["orientation.x", "orientation.y"], ["x", "y", "z", "w"], ["velocity_x", "velocity_y"]]) assert.equal(path(...names), null, names.join());
  assert.equal(viewOf(only([1, 2].map((at) => sample("/a", at, [["x", 3], ["y", 4]]))), null).position, null, "what stands still");
  const track = only([sample("/gps", 1, [["latitude", 60], ["longitude", 10]]), sample("/gps", 2, [["latitude", 60.001], ["longitude", 10.001]]), sample("/gps", 3, [["latitude", 400], ["longitude", 0]])]);
  assert.deepEqual(placesOf(track, viewOf(track, null).position!).map((one) => [Math.round(one.x), Math.round(one.y)]), [[0, 0], [56, 111]]);
});

test("a few short words over time are states; sentences are not", () => {
  const said = (...words: string[]) => words.map((text, at) => ({ at, text }));
  assert.deepEqual(statesOf(said("on", "on", "off", "on"), 9), [{ text: "on", from: 0, to: 2 }, { text: "off", from: 2, to: 3 }, { text: "on", from: 3, to: 9 }]);
  assert.deepEqual([statesOf(said("on", "off"), 9), statesOf(said("a", "b", "a", "something is in the way"), 9).length, statesOf(said("a", "b", "something is in the way, waiting"), 9), statesOf(said("a", "b", "c", "d", "e", "f", "g"), 9), statesOf([], 9)], [[], 4, [], [], []]);
});

test("the envelope of a message is not plotted, and words beside numbers are kept", () => {
  const track = only([sample("/a", 1, [["header.seq", 1], ["header.stamp.secs", 2], ["pose_covariance[0]", 1], ["speed", 3]])]);
  assert.deepEqual(viewOf(track, null).plots.flat().map((one) => one.name), ["speed"]);
  assert.deepEqual(withoutNumbers({ header: { frame_id: "map" }, state: "docked", level: 2, list: [1, 2], on: true, big: 2n }), { state: "docked" });
  assert.equal(withoutNumbers({ level: 2 }), undefined);
});

test("what the robot sent comes first, in the order of the description", () => {
  const model = { title: "", result: [{ topic: "/b" }, { topic: "/a" }], objective: [{ topic: "/go" }] };
  const { tracks } = gather([sample("/go", 1, [], { role: "objective" }), sample("/other", 1, []), sample("/a", 1, []), sample("/b", 1, [])]);
  assert.deepEqual(inOrder(tracks, model).map((track) => track.topic), ["/b", "/a", "/other", "/go"]);
});

test("numbers and times are short", () => {
  assert.deepEqual([0, 5, 12345, 12345.6, 123.45, 1.2345, -0.12345, 0.00001, 3e12].map(figure), ["0", "5", "12 345", "12 346", "123.5", "1.23", "−0.123", "1.00e-5", "3.00e12"]);
  assert.deepEqual([tickText(-172.85, 0.05), tickText(2, 2.5), tickText(12000, 500)], ["−172.85", "2.0", "12 000"]);
  assert.deepEqual([elapsed(3.21), elapsed(125), elapsed(3725.9)], ["3.2 s", "2:05", "1:02:05"]);
  assert.deepEqual([roundLength(7), roundLength(0.3), roundLength(199)], [5, 0.2, 100]);
  assert.deepEqual([placeAt([1, 2, 2, 3], 2), placeAt([1], 0), placeAt([], 1), placeAt([1, 2], 9)], [2, -1, -1, 1]);
});
