import { useEffect, useState } from "preact/hooks";
import { zeroAddress } from "viem";
import { post } from "../api";
import { useApp, useData, useModel, useTopic, wordsOf } from "../app";
import { isCid } from "../cid";
import { calls } from "../contracts";
import { amount, clock, duration, plain, short } from "../format";
import { LiveJob, Replay } from "../live";
import { stopJob } from "../ordering";
import { texts } from "../texts";
import { checkJob } from "../trust";
import type { Finding, Job, Step } from "../types";
import { Action, Badge, Copy, Facts, Money, Name, Picture, Show, StopDialog, Strange } from "../ui";
import { JobState } from "./account";
import { Steps } from "./follow";
import { nameOf } from "./robots";
import { Operate } from "./services";

/** A job by its contract's address: what happens in it, what happened, and whether that is true. */
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
  return <Show of={job}>{(known) => <JobView job={known} playback={playback ?? known.playback} changed={job.reload} />}</Show>;
}

const UNAVAILABLE = "recording-unavailable";
const PHASES = { incoming: 2, ready: 2, running: 3, complete: 4, finalized: 5 };

export function JobView(props: { job: Job; playback: Job["playback"]; changed: () => void }) {
  const { job, playback } = props;
  const { robotAt, account } = useApp();
  const { liability } = job;
  const stopper = texts.stoppedBy[job.stopped?.by !== liability.promisee ? "robot" : account?.address === liability.promisee ? "you" : "customer"];
  const description = useModel(liability.model)?.description ?? null;
  const robot = robotAt(liability.promisor);
  const ended = liability.isFinalized;
  const failed = ended && liability.state !== "paid";
  const owed = job.owed !== "0";
  const done = ended ? (failed ? 5 : 6) : PHASES[job.phase];
  const share = playback && playback.total ? playback.position / playback.total : undefined;
  const code = job.reason?.code ?? "";
  const title = description?.title ? plain(description.title, 80) : texts.job;
  return (
    <>
      <section class="hero small">
        <a href={`#/robot/${liability.promisor}`} tabIndex={-1} aria-hidden="true"><Picture address={liability.promisor} cid={robot?.profile?.picture} /></a>
        <div>
          <h1>{title}</h1>
          <p class="quiet">{texts.doneBy} {robot ? <a href={`#/robot/${liability.promisor}`}>{nameOf(robot)}</a> : <Name text={liability.promisor} href={`#/robot/${liability.promisor}`} />} · <Money units={liability.cost} token={liability.token} /></p>
        </div>
        <Stop job={job} changed={props.changed} />
      </section>
      <Steps done={done} active={!ended} failed={failed} share={job.phase === "running" || playback ? share : undefined} />
      <p class="lead" aria-live="polite">
        <JobState state={liability.state} /> {owed ? texts.owedNow(amount(job.owed, liability.token), !failed) : job.stopped ? `${stopper} ${ended ? (failed ? texts.stoppedBack : texts.stoppedPaid) : texts.jobStateLong.open}` : texts.jobStateLong[liability.state]}
        {playback && !ended && playback.total > 1 ? ` ${texts.played(playback.position, playback.total)}` : ""}
      </p>
      {job.reason && (!job.stopped || job.stopped.why) ? <p class={code === "stopped" ? "callout" : "problem"}><Strange text={job.reason.text || texts.reason[code] || ""} /> <code>{code}</code></p> : null}
      {owed ? <p class="hint">{texts.owedHow} <code>aira liability claim {liability.address}</code></p> : null}
      <Refund job={job} changed={props.changed} />
      {ended ? <p class="row"><a class="button quietly" href={`#/order/model/${liability.model}/${liability.promisor}/${liability.objective}`}>{texts.orderAgain}</a><Copy text={location.href} label={texts.copyLink} class="button quietly" /></p> : null}
      {liability.result ? <Replay cid={liability.result} model={description} /> : <LiveJob address={liability.address} model={description} />}
      <div class="columns">
        <section>
          <h2>{texts.timeline}</h2>
          <Timeline steps={job.timeline} owed={owed} />
        </section>
        <Evidence job={job} />
      </div>
      {ended ? null : <Operate robot={liability.promisor} job={liability.address} />}
      <details class="more" id="terms">
        <summary>{texts.terms}</summary>
        <Facts
          of={[
            [texts.contract, <Name text={liability.address} label={liability.address} />],
            [texts.price, <Money units={liability.cost} token={liability.token} />],
            [texts.person, <Name text={liability.promisee} href={`#/account/${liability.promisee}`} />],
            [texts.robot, <Name text={liability.promisor} href={`#/robot/${liability.promisor}`} />],
            [texts.model, <Name text={liability.model} href={`#/order/model/${liability.model}`} />],
            [texts.objective, <Name text={liability.objective} href={`#/file/${liability.objective}`} />],
            [texts.result, liability.result ? <Name text={liability.result} href={`#/file/${liability.result}`} /> : texts.notYet],
            [texts.validator, liability.validator === zeroAddress ? "" : <Name text={liability.validator} />],
            [texts.demand, job.demandHash ? <Name text={job.demandHash} href={`#/order/${job.demandHash}`} /> : ""],
            [texts.offer, job.offerHash ? <Name text={job.offerHash} href={`#/order/${job.offerHash}`} /> : ""],
          ]}
        />
      </details>
    </>
  );
}

/** Stops a job that this account ordered, and says what that costs. */
function Stop({ job, changed }: { job: Job; changed: () => void }) {
  const { account, notify } = useApp();
  const [open, setOpen] = useState(false);
  const { liability } = job;
  if (liability.isFinalized || account?.address !== liability.promisee || job.phase === "complete") return null;
  const stop = async () => {
    await stopJob(liability.address, "", account);
    notify(texts.stopSent);
    changed();
  };
  return (
    <>
      <button type="button" id="stop" class="button danger huge" onClick={() => setOpen(true)}>{texts.stop}</button>
      <StopDialog title={texts.stopTitle} open={open} close={() => setOpen(false)} stop={stop} notNow={texts.goOnWorking}>
        <p>{texts.stopHint}</p>
        <p><strong>{texts.stopCosts[job.onStop] ?? texts.stopCosts[""]}</strong></p>
      </StopDialog>
    </>
  );
}

function Timeline(props: { steps: Step[]; owed: boolean }) {
  const { market } = useApp();
  const first = props.steps.find((step) => step.at !== null)?.at ?? null;
  return (
    <ol class="timeline">
      {props.steps.map((step) => (
        <li key={`${step.kind}${step.at}${step.block}`}>
          <strong>{texts.stepName[props.owed && (step.kind === "paid" || step.kind === "refunded") ? "owed" : step.kind] ?? step.kind}</strong>
          <span class="quiet">
            {step.at !== null ? clock(step.at) : ""} {step.at !== null && first !== null && step.at > first ? `+${duration(step.at - first)}` : ""}{" "}
            {step.tx ? (market.explorer ? <a href={`${market.explorer}/tx/${step.tx}`} rel="noreferrer">{short(step.tx)}</a> : <Name text={step.tx} />) : null}
          </span>
          {isCid(step.detail) ? null : <Strange text={step.detail} />}
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
  if (left > 0) return <p class="hint">{texts.refundLater(amount(liability.cost, liability.token), duration(left * market.blockTime))}</p>;
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

/** Whether what is shown is true, in one line; what this browser and the server checked is opened on demand. */
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
  const all = [...own, ...(verification.data?.findings ?? [])];
  const lies = own.filter((finding) => finding.holds === false);
  const wrong = all.filter((finding) => finding.holds === false).length;
  const hold = all.filter((finding) => finding.holds).length;
  return (
    <section>
      <h2>{texts.checks}</h2>
      {lies.length ? <p class="problem" role="alert" id="lie">{texts.serverLies}</p> : null}
      {error ? <p class="problem">{error}</p> : null}
      <details class="more" id="checks" open={wrong > 0}>
        <summary>{!liability.isFinalized ? texts.checksLater : wrong ? <Badge kind="bad">{texts.checksFail(wrong, all.length)}</Badge> : <Badge kind="good">{texts.checksHold(hold, all.length - hold)}</Badge>}</summary>
        <h3>{texts.byBrowser}</h3>
        <Findings of={own} names={texts.ownCheck} />
        <h3>{texts.byServer}</h3>
        {liability.isFinalized ? <Show of={verification}>{({ findings }) => <Findings of={findings} names={texts.check} />}</Show> : null}
      </details>
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
