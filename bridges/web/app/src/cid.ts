// CIDv0 and files as trees of blocks, as in schemas/cid.py and schemas/unixfs.py.

import { texts } from "./texts";

const ALPHABET = "123456789ABCDEFGHJKLMNPQRSTUVWXYZabcdefghijkmnopqrstuvwxyz";
const CHUNK = 262_144;
const LINKS = 174;

export function encodeBase58(bytes: Uint8Array): string {
  let number = 0n;
  for (const byte of bytes) number = (number << 8n) | BigInt(byte);
  let text = "";
  for (; number > 0n; number /= 58n) text = ALPHABET[Number(number % 58n)] + text;
  for (const byte of bytes) {
    if (byte !== 0) break;
    text = "1" + text;
  }
  return text;
}

/** The 34 bytes that a CIDv0 names. Throws for any other text. */
export function parseCid(text: string): Uint8Array {
  let number = 0n;
  for (const letter of text) {
    const digit = ALPHABET.indexOf(letter);
    if (digit < 0) throw new Error(texts.notACid);
    number = number * 58n + BigInt(digit);
  }
  const bytes = new Uint8Array(34);
  for (let place = 33; place >= 0; place--, number >>= 8n) bytes[place] = Number(number & 0xffn);
  if (text.length !== 46 || number !== 0n || bytes[0] !== 0x12 || bytes[1] !== 0x20) {
    throw new Error(texts.notACid);
  }
  return bytes;
}

export function isCid(text: string): boolean {
  try {
    return parseCid(text).length === 34;
  } catch {
    return false;
  }
}

interface Subtree {
  multihash: Uint8Array;
  fileSize: number;
  treeSize: number;
}

/** The CIDv0 that `ipfs add` gives a file with these bytes. */
export async function cidOf(data: Uint8Array): Promise<string> {
  let level: Subtree[] = [];
  for (let start = 0; start === 0 || start < data.length; start += CHUNK) {
    level.push(await leaf(data.subarray(start, start + CHUNK)));
  }
  while (level.length > 1) {
    const parents: Subtree[] = [];
    for (let start = 0; start < level.length; start += LINKS) parents.push(await parent(level.slice(start, start + LINKS)));
    level = parents;
  }
  return encodeBase58(level[0].multihash);
}

async function leaf(chunk: Uint8Array): Promise<Subtree> {
  const unixfs = join(number(1, 2), chunk.length ? bytes(2, chunk) : new Uint8Array(), number(3, chunk.length));
  return hashed(bytes(1, unixfs), chunk.length, 0);
}

async function parent(children: Subtree[]): Promise<Subtree> {
  const links = children.map((child) =>
    bytes(2, join(bytes(1, child.multihash), bytes(2, new Uint8Array()), number(3, child.treeSize))),
  );
  const fileSize = children.reduce((sum, child) => sum + child.fileSize, 0);
  const sizes = children.map((child) => number(4, child.fileSize));
  const below = children.reduce((sum, child) => sum + child.treeSize, 0);
  return hashed(join(...links, bytes(1, join(number(1, 2), number(3, fileSize), ...sizes))), fileSize, below);
}

async function hashed(block: Uint8Array<ArrayBuffer>, fileSize: number, below: number): Promise<Subtree> {
  const digest = new Uint8Array(await crypto.subtle.digest("SHA-256", block));
  return { multihash: join(new Uint8Array([0x12, 0x20]), digest), fileSize, treeSize: below + block.length };
}

function number(field: number, value: number): Uint8Array {
  return join(varint(field * 8), varint(value));
}

function bytes(field: number, value: Uint8Array): Uint8Array<ArrayBuffer> {
  return join(varint(field * 8 + 2), varint(value.length), value);
}

function varint(value: number): Uint8Array {
  const digits: number[] = [];
  for (; value > 127; value = Math.floor(value / 128)) digits.push((value % 128) | 128);
  return new Uint8Array([...digits, value]);
}

function join(...parts: Uint8Array[]): Uint8Array<ArrayBuffer> {
  const whole = new Uint8Array(parts.reduce((sum, part) => sum + part.length, 0));
  let at = 0;
  for (const part of parts) {
    whole.set(part, at);
    at += part.length;
  }
  return whole;
}
