import { useState } from "preact/hooks";
import { isAddress } from "viem";
import { query } from "../api";
import { useApp, useData } from "../app";
import { texts } from "../texts";
import type { Liability } from "../types";
import { Field, Show, WordField } from "../ui";
import { JobTable } from "./account";

/** All jobs, or those of the account; newest first. */
export function JobsPage() {
  const { account } = useApp();
  const [phase, setPhase] = useState("");
  const [mine, setMine] = useState(true);
  const [wanted, setWanted] = useState("");
  const party = mine ? account?.address : undefined;
  const jobs = useData<{ liabilities: Liability[]; more: boolean; phases: Record<string, number> }>(`liabilities${query({ phase, party, limit: 100 })}`, "chain");
  return (
    <>
      <h1>{texts.jobs}</h1>
      <form class="row end" onSubmit={(event) => { event.preventDefault(); if (wanted) location.hash = `#/job/${wanted}`; }}>
        <Field label={texts.phaseTitle}>
          {(id) => (
            <select id={id} value={phase} onChange={(event) => setPhase(event.currentTarget.value)}>
              <option value="">{texts.all}</option>
              {Object.entries(texts.phase).map(([name, title]) => <option key={name} value={name}>{title} ({jobs.data?.phases[name] ?? 0})</option>)}
            </select>
          )}
        </Field>
        {account ? (
          <label class="check"><input type="checkbox" checked={mine} onChange={(event) => setMine(event.currentTarget.checked)} /> {texts.onlyMine}</label>
        ) : null}
        <WordField label={texts.byAddress} text={wanted} change={setWanted} placeholder="0x…" />
        <button class="button small" disabled={!isAddress(wanted)}>{texts.show}</button>
      </form>
      <Show of={jobs}>{({ liabilities, more }) => <><JobTable liabilities={liabilities} />{more ? <p class="hint">{texts.moreJobs}</p> : null}</>}</Show>
    </>
  );
}
