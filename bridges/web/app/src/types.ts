// What the server answers: see openapi.json.

import type { Address, Hex } from "viem";

export interface Token {
  address: Address;
  symbol: string;
  decimals: number;
}

export interface Robot {
  model: string;
  objective: string | null;
  cost: string | null;
  title: string;
  text: string;
}

export interface Market {
  lighthouse: { name: string; address: Address };
  chainId: number;
  generation: 3 | 5;
  contracts: string;
  block: number;
  blockTime: number;
  factory: Address;
  xrt: Token;
  ens: Address;
  token: Token;
  defaultLifetime: number;
  account: Address | null;
  role: "anybody" | "operator";
  providers: Address[];
  connected: { router: boolean; chain: boolean };
  limits: { upload: number; orders: number; lifetime: number };
  robot: Robot | null;
  /** Whether operators who logged in allow orders of programs here. */
  asksForConsent: boolean;
  explorer: string;
  version: string;
  stream: string;
}

/** An order of a program that waits for a person's yes. */
export interface Consent {
  id: string;
  model: string;
  robot: string;
  cost: { text: string };
  messages: { text: string }[];
  more: number;
  why: string;
  note: { text: string };
  expires: string;
}

export interface JobRecord {
  created: number;
  done: number;
  failed: number;
  open: number;
  earned: string;
}

export interface Order {
  hash: string;
  kind: "demand" | "offer";
  signer: Address;
  model: string;
  objective: string;
  token: Address;
  cost: string;
  lighthouse: Address;
  validator: Address;
  validatorFee?: string;
  lighthouseFee?: string;
  deadline: number;
  nonce: string;
  sender: Address | null;
  signature: string;
  generation: number;
  at: number;
  /** For one robot alone: nobody else gets its signature. */
  private?: boolean;
}

export interface Statement {
  kind: "rejected" | "declined";
  agent: Address;
  code: string;
  detail: string;
  at: number;
}

/** A Result without a contract: its liability is the account that asked. */
export interface Answer {
  liability: Address;
  result: string;
  success: boolean;
  signature: string;
  signer: Address;
  at: number;
}

export interface PostedOrder {
  order: Order;
  state: "open" | "withdrawn" | "contract" | "expired";
  liability: Address | null;
  statements: Statement[];
  answers: Answer[];
}

export interface LogEvent {
  sequence: number;
  time: string;
  level: string;
  event?: string;
  message: string;
  liability?: Address;
}

export interface AgentStatus {
  version?: string;
  parts?: Record<string, string>;
  head?: number;
  uptime?: number;
  work?: { jobs: Record<string, number>; outbox: number; store: { files: number; bytes: number; quota: number | null } };
  market?: {
    openOrders: number;
    created: number;
    finalized: number;
    rejected: Record<string, number>;
    gasUsed: number;
    spent: string;
    fees: string;
    minted: string;
  };
  validation?: { validators: Address[]; policies: string[]; fee: number; cases: Record<string, number> };
  dropped?: Record<string, number>;
}

/** How a robot presents itself: its owner's words. */
export interface Profile {
  name: string;
  about: string;
  picture: string;
  place: string;
  price: string;
  state: "idle" | "working" | "stopped" | "closed";
  queue: number;
  wait: number;
  readings: Record<string, string>;
  time: number;
  /** The addresses that it had before, by messages that they signed. */
  formerly?: Address[];
}

/** What a robot wants for an objective; with a `code`, why it does not want it. */
export interface Quote {
  agent: Address;
  name: string;
  cost: string;
  token: Token;
  validator: string;
  start: number;
  seconds: number;
  until: number;
  code: string;
  detail: string;
}

/** What has happened to a robot, for its owner. */
export interface RobotEvent {
  event: string;
  time: number;
  /** A contract's address, or an order's hash; may be empty. */
  about: string;
  detail: string;
}

/** What an owner may change while the robot works; and who is told of what. */
export interface OwnerRules {
  price: string;
  paused: boolean;
  refuse: Address[];
  leastPrice: string;
  held: boolean;
  here: boolean;
  notify: { target: string; waiting: number }[];
  events: RobotEvent[];
}

/** A contract in the account's statement: amounts in the smallest unit. */
export interface Entry {
  time: string;
  month: string;
  liability: Address;
  state: Liability["state"];
  promisee: Address;
  promisor: Address;
  model: string;
  token: Address;
  symbol: string;
  decimals: number;
  cost: string;
  earned: string;
  spent: string;
}

/** A contract in the history of the market. */
export interface PastJob {
  address: Address;
  model: string;
  cost: string;
  token: Token;
  state: Liability["state"];
  promisor: Address;
  promisee: Address;
  block: number;
  at: number | null;
}

export interface Agent {
  role: string;
  address: Address;
  health: "alive" | "degraded" | "silent" | "away";
  status: AgentStatus | null;
  models: string[];
  offers: Order[];
  record: JobRecord;
  profile: Profile | null;
  /** When it was here last; only if it is away. */
  since?: number;
}

export interface Agents {
  agents: Agent[];
  away: (Pick<Agent, "address" | "models" | "record" | "profile"> & { since: number })[];
  unlisted: number;
  alerts: { agent: Address; code: string; detail: string }[];
}

export interface ValueSchema {
  type?: string;
  title?: string;
  description?: string;
  unit?: string;
  default?: string | number | boolean | null;
  enum?: (string | number)[];
  minimum?: number;
  maximum?: number;
  exclusiveMinimum?: number;
  exclusiveMaximum?: number;
  minLength?: number;
  maxLength?: number;
  contentEncoding?: string;
  items?: ValueSchema;
  minItems?: number;
  maxItems?: number;
  properties?: Record<string, ValueSchema>;
  required?: string[];
}

export interface ModelTopic {
  topic: string;
  title?: string;
  description?: string;
  encoding?: string;
  value?: ValueSchema | null;
  required?: boolean;
  maxMessages?: number | null;
}

export interface Description {
  title: string;
  description?: string;
  objective?: ModelTopic[];
  result?: ModelTopic[];
  success?: string;
  price?: string;
  seconds?: number | null;
  /** What becomes of the price when the customer stops a job. */
  onStop?: "refund" | "paid";
  limits?: { messages?: number; seconds?: number; size?: number } | null;
}

export interface Model {
  cid: string;
  described: boolean;
  description: Description | null;
  text: string | null;
}

export interface TopicSummary {
  topic: string;
  role: "objective" | "device";
  messages: number;
  types: string[];
  shown: "values" | "image" | "text" | "bytes" | "none";
}

export interface Summary {
  cid: string;
  format: string;
  size: number;
  messages: number;
  startNs: string;
  durationNs: string;
  topics: TopicSummary[];
  metadata: Record<string, Record<string, string>>;
  attachments: { name: string; mediaType: string; size: number }[];
}

export interface Objective {
  cid: string;
  size: number;
  summary: Summary;
  preflight: { ok: boolean; reason: string; detail: string };
}

export interface Message {
  number: number;
  topic: string;
  role: string;
  type: string;
  at: number;
  size: number;
  value: unknown;
  cut: boolean;
  image: string | null;
}

export interface Values {
  topic: string;
  messages: number;
  points: number;
  at: number[];
  columns: { name: string; values: (number | null)[] }[];
}

export interface Liability {
  address: Address;
  model: string;
  objective: string;
  result: string;
  promisee: Address;
  promisor: Address;
  lighthouse: Address;
  lighthouseFee: string;
  token: Token;
  cost: string;
  validator: Address;
  validatorFee: string;
  isSuccess: boolean;
  isFinalized: boolean;
  state: "open" | "paid" | "failed" | "called-off";
}

export interface Step {
  kind: string;
  at: number | null;
  block: number | null;
  tx: Hex | null;
  agent: Address | null;
  detail: string;
}

export interface Job {
  liability: Liability;
  phase: "incoming" | "ready" | "running" | "complete" | "finalized";
  playback: { position: number; total: number } | null;
  demandHash: string | null;
  offerHash: string | null;
  refundableFrom: number | null;
  owed: string;
  timeline: Step[];
  resultMessage: { liability: Address; result: string; success: boolean; signature: string; signer: Address } | null;
  reason: { code: string; text: string } | null;
  /** Whether a stopped job is paid, as its model says; empty if it does not say. */
  onStop: "refund" | "paid" | "";
  stopped: { by: Address; why: string } | null;
}

export interface Finding {
  name: string;
  holds: boolean | null;
  detail: string;
}

export interface AccountState {
  address: Address;
  eth: string;
  xrt: { balance: string; allowance: string };
  token: { balance: string; allowance: string };
  /** Whether it may sign a permit instead of sending an approval, where the token has permits. */
  permits: boolean;
  nonce: string | null;
  transactions: number;
  stake: string;
  orders: PostedOrder[];
  record: JobRecord;
  spent: string;
  liabilities: Liability[];
}

export interface Lighthouse {
  name: string;
  address: Address;
  minimalStake: string;
  timeoutBlocks: number;
  keepAliveBlock: number;
  quotaLeft: number;
  current: Address;
  block: number;
  providers: { address: Address; stake: string; quota: number; hasTurn: boolean; status: AgentStatus | null }[];
  gasPrice: string;
}

/** How a validator judges, as its jurors announce it. */
export interface Validator {
  validator: Address;
  title: string;
  jurors: number;
  quorum: number;
  online: Address[];
  policies: { name: string; description: string }[];
  unanimous: boolean;
  announcedFee: string | null;
  fee: string;
  refundDelay: number | null;
  blockTime: number | null;
  doubts: Record<string, string>;
  refund: string;
  announcements: { juror: Address; text: string; signature: string }[];
}

export interface StreamEvent {
  seq: number;
  topic?: string;
  kind: string;
  data?: any;
  at: number;
}
