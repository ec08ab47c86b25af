import { useEffect, useState } from "preact/hooks";
import { useApp, useData, useTopic, wordsOf } from "../app";
import { post } from "../api";
import { isCid } from "../cid";
import { calls } from "../contracts";
import { amount, clock, duration, short } from "../format";
import { Replay } from "../live";
import { texts } from "../texts";
import { checkJob } from "../trust";
import type { Finding, Job, Step } from "../types";
import { Action, Badge, Facts, Money, Name, Show, Strange } from "../ui";
import { JobState } from "./account";
import { Steps } from "./follow";
import { Operate } from "./robots";

/** A job by its contract's address: terms, parties, files, timeline, and the checks. */
export function JobPage(props: { address: string }) {
  const job = useData<Job>(`liabilities/${props.address}`);
  const [playback, setPlayback] = useState<Job["playback"]>(null);
  useTopic(`liability/${props.address}`, (event) => {
    if (event.kind === "playing" && event.data?.total) setPlayback(event.data);
    else job.reload();
  });
  // A failed job's recording, which says why, may come after the contract's end.
  const unexplained = job.data?.liability.state === "failed" && job.data.liability.result !== "" && (job.data.reason?.code ?? UNAVAILABLE) === UNAVAILABLE;
  useTopic("chain", () => job.data && (!job.data.liability.isFinalized || unexplained) && job.reload());
  return (
    <>
      <div class="row between">
        <h1>{texts.job} <Name text={props.address} /></h1>
        <CopyLink />
      </div>
      <Show of={job}>{(known) => <JobView job={known} playback={playback ?? known.playback} changed={job.reload} />}</Show>
    </>
  );
}

const UNAVAILABLE = "recording-unavailable";
const PHASES = { incoming: 2, ready: 2, running: 3, complete: 4, finalized: 5 };

export function JobView(props: { job: Job; playback: Job["playback"]; changed: () => void }) {
  const { job, playback } = props;
  const { liability } = job;
  const ended = liability.isFinalized;
  const failed = ended && liability.state !== "paid";
  const owed = job.owed !== "0";
  const done = ended ? (failed ? 5 : 6) : PHASES[job.phase];
  const share = playback && playback.total ? playback.position / playback.total : undefined;
  return (
    <>
      <Steps done={done} active={!ended} failed={failed} share={job.phase === "running" || playback ? share : undefined} />
      <p class="lead" aria-live="polite">
        <JobState state={liability.state} /> {owed ? texts.owedNow(amount(job.owed, liability.token), !failed) : texts.jobStateLong[liability.state]}
        {playback && !ended ? ` ${texts.played(playback.position, playback.total)}` : ""}
      </p>
      {job.reason ? <p class="problem"><Strange text={job.reason.text || texts.reason[job.reason.code] || ""} /> <code>{job.reason.code}</code></p> : null}
      {owed ? <p class="hint">{texts.owedHow} <code>aira liability claim {liability.address}</code></p> : null}
      <Refund job={job} changed={props.changed} />
      {ended ? <p><a class="button quietly" href={`#/order/model/${liability.model}`}>{texts.orderAgain}</a></p> : <Operate robot={liability.promisor} job={liability.address} />}
      <div class="columns">
        <section>
          <h2>{texts.terms}</h2>
          <Facts
            of={[
              [texts.price, <Money units={liability.cost} token={liability.token} />],
              [texts.person, <Name text={liability.promisee} href={`#/account/${liability.promisee}`} />],
              [texts.robot, <Name text={liability.promisor} href={`#/account/${liability.promisor}`} />],
              [texts.model, <Name text={liability.model} href={`#/order/model/${liability.model}`} />],
              [texts.objective, <Name text={liability.objective} href={`#/file/${liability.objective}`} />],
              [texts.result, liability.result ? <Name text={liability.result} href={`#/file/${liability.result}`} /> : texts.notYet],
              [texts.validator, /^0x0+$/.test(liability.validator) ? "" : <Name text={liability.validator} />],
              [texts.demand, job.demandHash ? <Name text={job.demandHash} href={`#/order/${job.demandHash}`} /> : ""],
              [texts.offer, job.offerHash ? <Name text={job.offerHash} href={`#/order/${job.offerHash}`} /> : ""],
            ]}
          />
        </section>
        <section>
          <h2>{texts.timeline}</h2>
          <Timeline steps={job.timeline} owed={owed} />
        </section>
      </div>
      {liability.result ? (
        <section>
          <h2>{texts.recording}</h2>
          <Replay cid={liability.result} model={null} />
        </section>
      ) : null}
      <Evidence job={job} />
    </>
  );
}

/** The address of this page stays: it names the contract. */
function CopyLink() {
  const { notify } = useApp();
  const copy = async () => {
    await navigator.clipboard.writeText(location.href);
    notify(texts.copied);
  };
  return <Action class="button small quietly" run={copy}>{texts.copyLink}</Action>;
}

function Timeline(props: { steps: Step[]; owed: boolean }) {
  const { market } = useApp();
  return (
    <ol class="timeline">
      {props.steps.map((step) => (
        <li key={`${step.kind}${step.at}${step.block}`}>
          <strong>{texts.stepName[props.owed && (step.kind === "paid" || step.kind === "refunded") ? "owed" : step.kind] ?? step.kind}</strong>
          <span class="quiet">
            {step.at !== null ? clock(step.at) : ""} {step.block !== null ? texts.block(step.block) : ""}{" "}
            {step.tx ? (market.explorer ? <a href={`${market.explorer}/tx/${step.tx}`} rel="noreferrer">{short(step.tx)}</a> : <Name text={step.tx} />) : null}
          </span>
          {isCid(step.detail) ? <Name text={step.detail} href={`#/file/${step.detail}`} /> : <Strange text={step.detail} />}
        </li>
      ))}
    </ol>
  );
}

function Refund(props: { job: Job; changed: () => void }) {
  const { account, block, market, send, notify } = useApp();
  const { liability, refundableFrom } = props.job;
  if (liability.isFinalized || refundableFrom === null || account?.address !== liability.promisee) return null;
  const left = refundableFrom - block;
  if (left > 0) return <p class="hint">{texts.refundLater(amount(liability.cost, liability.token), refundableFrom, duration(left * market.blockTime))}</p>;
  const refund = async () => {
    if (account.kind === "local") await post("local/refunds", { liability: liability.address });
    else await send(market.factory, calls.refund(liability.address));
    notify(texts.refunded);
    props.changed();
  };
  return (
    <div class="callout">
      <p>{texts.refundNow}</p>
      <Action id="refund" run={refund}>{texts.refundButton(amount(liability.cost, liability.token))}</Action>
    </div>
  );
}

/** What this browser checked itself, and beside it the checklist that the server made. */
function Evidence({ job }: { job: Job }) {
  const { account, market } = useApp();
  const [own, setOwn] = useState<Finding[]>([]);
  const [error, setError] = useState("");
  const { liability } = job;
  const verification = useData<{ holds: boolean; findings: Finding[] }>(liability.isFinalized ? `liabilities/${liability.address}/verification` : null);
  useEffect(() => {
    let current = true;
    setOwn([]);
    (async () => {
      for await (const finding of checkJob(job, account, market)) if (current) setOwn((known) => [...known, finding]);
    })().catch((problem) => setError(wordsOf(problem)));
    return () => {
      current = false;
    };
  }, [liability.address, liability.isFinalized, liability.result, job.resultMessage?.signature, account?.address]);
  const lies = own.filter((finding) => finding.holds === false);
  return (
    <section>
      <h2>{texts.checks}</h2>
      {lies.length ? <p class="problem" role="alert" id="lie">{texts.serverLies}</p> : null}
      {error ? <p class="problem">{error}</p> : null}
      <div class="columns">
        <div>
          <h3>{texts.byBrowser}</h3>
          <Findings of={own} names={texts.ownCheck} />
        </div>
        <div>
          <h3>{texts.byServer}</h3>
          {liability.isFinalized ? <Show of={verification}>{({ findings }) => <Findings of={findings} names={texts.check} />}</Show> : <p class="quiet">{texts.checksLater}</p>}
        </div>
      </div>
    </section>
  );
}

function Findings(props: { of: Finding[]; names: Record<string, string> }) {
  return (
    <ul class="findings">
      {props.of.map((finding) => (
        <li key={finding.name}>
          <Badge kind={finding.holds === null ? "calm" : finding.holds ? "good" : "bad"}>{finding.holds === null ? texts.open : finding.holds ? texts.holds : texts.fails}</Badge>
          <span><strong>{props.names[finding.name] ?? finding.name}</strong> <Strange text={finding.detail} /></span>
        </li>
      ))}
    </ul>
  );
}
