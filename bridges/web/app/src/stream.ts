// The server's events: one WebSocket for all subscriptions, resumed after a break.

import type { StreamEvent } from "./types";

type Listener = (event: StreamEvent) => void;

const FIRST_DELAY = 300;
const LONGEST_DELAY = 3000;

class Stream {
  private readonly listeners = new Map<string, Set<Listener>>();
  private readonly watchers = new Set<(live: boolean) => void>();
  private socket: WebSocket | null = null;
  private delay = FIRST_DELAY;
  private seq = 0;
  private id = "";
  private planned = false;
  /** Whether the connection is open; null until it has been tried. */
  live: boolean | null = null;

  /** Calls `listener` for each event of a topic, and with kind `gap` when some were missed. Returns what ends it. */
  on(topic: string, listener: Listener): () => void {
    const known = this.listeners.get(topic) ?? new Set();
    this.listeners.set(topic, known.add(listener));
    this.plan();
    return () => {
      known.delete(listener);
      if (!known.size) this.listeners.delete(topic);
      this.plan();
    };
  }

  /** Calls `watcher` when the connection comes or goes. */
  watch(watcher: (live: boolean) => void): () => void {
    this.watchers.add(watcher);
    return () => this.watchers.delete(watcher);
  }

  private plan(): void {
    if (this.planned) return;
    this.planned = true;
    queueMicrotask(() => {
      this.planned = false;
      if (this.socket) this.subscribe(false);
      else if (this.listeners.size) this.open();
    });
  }

  private open(): void {
    const socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/api/v1/stream`);
    this.socket = socket;
    socket.onopen = () => {
      this.delay = FIRST_DELAY;
      this.subscribe(true);
      this.setLive(true);
    };
    // Each text is an array of events.
    socket.onmessage = (message) => (JSON.parse(message.data) as StreamEvent[]).forEach((event) => this.receive(event));
    socket.onclose = () => {
      this.setLive(false);
      setTimeout(() => this.open(), this.delay * (0.5 + Math.random()));
      this.delay = Math.min(this.delay * 2, LONGEST_DELAY);
    };
  }

  private subscribe(resume: boolean): void {
    if (this.socket?.readyState !== WebSocket.OPEN) return;
    const position = resume && this.id ? { after: this.seq, stream: this.id } : {};
    this.socket.send(JSON.stringify({ subscribe: [...this.listeners.keys()], ...position }));
  }

  private receive(event: StreamEvent): void {
    if (event.kind === "hello") {
      const known = this.id;
      if (known === event.data.stream) return;
      this.id = event.data.stream;
      this.seq = event.data.seq;
      if (known) this.tellAll({ ...event, kind: "gap" });
      return;
    }
    this.seq = Math.max(this.seq, event.seq);
    if (event.topic === undefined) this.tellAll(event);
    else for (const listener of this.listeners.get(event.topic) ?? []) listener(event);
  }

  private tellAll(event: StreamEvent): void {
    for (const known of this.listeners.values()) for (const listener of known) listener(event);
  }

  private setLive(live: boolean): void {
    this.live = live;
    for (const watcher of this.watchers) watcher(live);
  }
}

export const stream = new Stream();
