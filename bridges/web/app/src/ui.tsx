// The pieces that pages are made of.

import { cloneElement, toChildArray } from "preact";
import type { ComponentChildren, VNode } from "preact";
import { useEffect, useId, useRef, useState } from "preact/hooks";
import { isAddress } from "viem";
import { isUnreachable, useApp, wordsOf } from "./app";
import type { Loaded } from "./app";
import { amount, plain, short } from "./format";
import { decimalText, parseDecimal } from "./numbers";
import { texts } from "./texts";
import type { Token } from "./types";

/** An address by the name of its robot, a hash or a CID: short, whole in its title, with a button that copies it. */
export function Name(props: { text: string; href?: string; label?: string }) {
  const { account, robotAt, market } = useApp();
  const own = account?.address === props.text;
  const [copied, setCopied] = useState(false);
  const named = plain(robotAt(props.text)?.profile?.name ?? "", 80);
  const visible = props.label ?? (own ? texts.you : named || short(props.text));
  const copy = async () => {
    await navigator.clipboard.writeText(props.text);
    setCopied(true);
    setTimeout(() => setCopied(false), 1200);
  };
  return (
    <span class="name" title={props.text}>
      {props.href ? <a href={props.href}>{visible}</a> : <span>{visible}</span>}
      <button type="button" class="copy" aria-label={texts.copy(props.text)} onClick={copy}>
        <svg viewBox="0 0 16 16" width="14" height="14" aria-hidden="true" fill="none" stroke="currentColor" stroke-width="1.5">
          {copied ? <path d="M3 8.500 6.500 12 13 4.500" /> : <path d="M5.500 5.500h8v8h-8zM10.500 5.500v-3h-8v8h3" />}
        </svg>
      </button>
      {isAddress(props.text) && market.explorer ? <a class="copy" href={`${market.explorer}/address/${props.text}`} rel="noreferrer" target="_blank" aria-label={texts.inExplorer(props.text)}>↗</a> : null}
    </span>
  );
}

/** A robot's picture, or a pattern of its address. */
export function Picture(props: { address: string; cid?: string; size?: "small" | "large" }) {
  const [broken, setBroken] = useState(false);
  const kind = `portrait ${props.size ?? ""}`;
  if (props.cid && !broken) return <img class={kind} src={`/api/v1/files/${props.cid}/picture`} alt="" loading="lazy" onError={() => setBroken(true)} />;
  const digits = [...props.address.slice(2).toLowerCase()].map((digit) => parseInt(digit, 16));
  const hue = (digits[0] * 16 + digits[1]) * 360 / 256;
  const cells = Array.from({ length: 15 }, (_, place) => place).filter((place) => digits[place + 2] % 2);
  return (
    <svg class={kind} viewBox="-1.500 -1.500 8 8" aria-hidden="true" preserveAspectRatio="xMidYMid meet">
      <rect x="-30" y="-30" width="66" height="66" fill={`oklch(0.42 0.07 ${hue})`} />
      {cells.flatMap((place) => {
        const [x, y] = [place % 3, Math.floor(place / 3)];
        return [...new Set([x, 4 - x])].map((column) => <rect key={`${place}${column}`} x={column} y={y} width="1.02" height="1.02" fill={`oklch(0.82 0.11 ${hue})`} />);
      })}
    </svg>
  );
}

export function Money(props: { units: string; token: Token }) {
  return <span class="number">{amount(props.units, props.token)}</span>;
}

export function Strange(props: { text: string; most?: number }) {
  return <bdi class="strange">{plain(props.text, props.most)}</bdi>;
}

export function Badge(props: { kind: "good" | "bad" | "warn" | "calm"; children: ComponentChildren }) {
  return <span class={`badge ${props.kind}`}>{props.children}</span>;
}

/** A button for what takes time: it waits, and says what failed. */
export function Action(props: {
  children: ComponentChildren;
  run: () => Promise<unknown> | unknown;
  class?: string;
  disabled?: boolean;
  id?: string;
  onError?: (error: unknown) => void;
}) {
  const { notify } = useApp();
  const [busy, setBusy] = useState(false);
  const run = async () => {
    setBusy(true);
    try {
      await props.run();
    } catch (error) {
      if (props.onError) props.onError(error);
      else notify(wordsOf(error), "bad");
    } finally {
      setBusy(false);
    }
  };
  return (
    <button type="button" id={props.id} class={props.class ?? "button"} disabled={props.disabled || busy} aria-busy={busy} onClick={run}>
      {props.children}
    </button>
  );
}

/** A button that copies a text. */
export function Copy(props: { text: string; label: string; class: string }) {
  const { notify } = useApp();
  const copy = async () => {
    await navigator.clipboard.writeText(props.text);
    notify(texts.copied);
  };
  return <Action class={props.class} run={copy}>{props.label}</Action>;
}

export function Field(props: { label: ComponentChildren; hint?: ComponentChildren; error?: string; children: (id: string, described: string) => ComponentChildren }) {
  const id = useId();
  return (
    <div class={props.error ? "field wrong" : "field"}>
      <label for={id}>{props.label}</label>
      {props.children(id, `${id}-hint`)}
      <p id={`${id}-hint`} class="hint">{props.error || props.hint}</p>
    </div>
  );
}

/** A field for one word: an address, a CID, a name. */
export function WordField(props: { label: ComponentChildren; text: string; change: (text: string) => void; error?: string; hint?: ComponentChildren; placeholder?: string }) {
  return (
    <Field label={props.label} error={props.error} hint={props.hint}>
      {(id, described) => <input id={id} aria-describedby={described} class="wide" spellcheck={false} value={props.text} placeholder={props.placeholder} onInput={(event) => props.change(event.currentTarget.value.trim())} />}
    </Field>
  );
}

/** A field for a number: it keeps the text as it is typed, and says what it means where that is not plain. */
export function NumberField(props: { label: ComponentChildren; text: string; change: (text: string) => void; error?: string; hint?: ComponentChildren; class?: string; signed?: boolean }) {
  const number = /[^\d.\s-]/.test(props.text) && !props.error ? parseDecimal(props.text) : null;
  return (
    <Field label={props.label} error={props.error} hint={number ? `= ${decimalText(number)}` : props.hint}>
      {(id, described) => (
        <input id={id} aria-describedby={described} aria-invalid={Boolean(props.error)} class={props.class} inputMode={props.signed ? undefined : "decimal"} autocomplete="off" spellcheck={false}
          value={props.text} onInput={(event) => props.change(event.currentTarget.value)} />
      )}
    </Field>
  );
}

/** What was loaded, or why not. */
export function Show<T>(props: { of: Loaded<T>; children: (data: T) => ComponentChildren }) {
  const { data, error, loading, reload } = props.of;
  if (data !== null) {
    return (
      <>
        {error && !isUnreachable(error) ? <Problem error={error} retry={reload} /> : null}
        {props.children(data)}
      </>
    );
  }
  if (error) return <Problem error={error} retry={reload} />;
  return loading ? <p class="quiet" aria-busy="true">{texts.loading}</p> : null;
}

export function Problem(props: { error: unknown; retry?: () => void }) {
  return (
    <div class="problem" role="alert">
      <p><Strange text={wordsOf(props.error)} /></p>
      {props.retry ? <button type="button" class="button small" onClick={props.retry}>{texts.again}</button> : null}
    </div>
  );
}

type Row = VNode<{ children: ComponentChildren }>;

/** A table of `tr` with `td`; on a phone a row is lines of cells, each with the title of its column. */
export function Table(props: { label: string; head: string[]; numbers?: number[]; children: Row[]; empty?: string }) {
  if (!props.children.length && props.empty) return <p class="quiet">{props.empty}</p>;
  return (
    <div class="scroll" tabIndex={0} role="region" aria-label={props.label}>
      <table class="cells">
        <caption class="hidden">{props.label}</caption>
        <thead>
          <tr>{props.head.map((title, place) => <th key={title} scope="col" class={props.numbers?.includes(place) ? "right" : ""}>{title}</th>)}</tr>
        </thead>
        <tbody>{props.children.map((row) => cloneElement(row, {}, titled(row, props.head)))}</tbody>
      </table>
    </div>
  );
}

function titled(row: Row, head: string[]): VNode[] {
  return toChildArray(row.props.children).map((cell, place) => cloneElement(cell as VNode<object>, { "data-title": head[place] || undefined }));
}

export function Facts(props: { of: [string, ComponentChildren][] }) {
  return (
    <dl class="facts">
      {props.of.filter(([, value]) => value !== null && value !== undefined && value !== "").map(([name, value]) => (
        <div key={name}><dt>{name}</dt><dd>{value}</dd></div>
      ))}
    </dl>
  );
}

/** Asks before something is stopped. */
export function StopDialog(props: { title: string; open: boolean; close: () => void; stop: () => Promise<unknown>; notNow: string; children: ComponentChildren }) {
  const stop = async () => {
    await props.stop();
    props.close();
  };
  return (
    <Dialog title={props.title} open={props.open} onClose={props.close}>
      {props.children}
      <p class="row">
        <Action id="stop-now" class="button danger" run={stop}>{texts.stopNow}</Action>
        <button type="button" class="button quietly" onClick={props.close}>{props.notNow}</button>
      </p>
    </Dialog>
  );
}

export function Dialog(props: { title: string; open: boolean; onClose: () => void; children: ComponentChildren }) {
  const box = useRef<HTMLDialogElement>(null);
  const id = useId();
  useEffect(() => {
    const dialog = box.current!;
    if (props.open && !dialog.open) dialog.showModal();
    if (!props.open && dialog.open) dialog.close();
  }, [props.open]);
  return (
    <dialog ref={box} aria-labelledby={id} onClose={props.onClose}>
      <header>
        <h2 id={id}>{props.title}</h2>
        <button type="button" class="close" aria-label={texts.close} onClick={props.onClose}>×</button>
      </header>
      {props.open ? props.children : null}
    </dialog>
  );
}
