import { useState } from "preact/hooks";
import { zeroAddress } from "viem";
import { useApp, useData } from "../app";
import { amount, parseAmount, plain } from "../format";
import { texts } from "../texts";
import type { Model, Objective, Robot } from "../types";
import { Show, Strange } from "../ui";
import { AccountControl } from "./account";
import { ObjectiveChoice } from "./objective";
import { OrderButton } from "./order";

/** The page of one robot: what it does, what it costs, one button. Fit for a frame in another site. */
export function RobotPage({ robot }: { robot: Robot }) {
  const { market, account } = useApp();
  const model = useData<Model>(`models/${robot.model}`);
  const [objective, setObjective] = useState<Objective | null>(null);
  const description = model.data?.description;
  const cid = robot.objective ?? objective?.cid;
  const [number, unit] = (description?.price ?? "").split(" ");
  const typical = unit === market.token.symbol ? parseAmount(number, market.token.decimals) ?? 0n : 0n;
  const cost = robot.cost !== null ? BigInt(robot.cost) : typical;
  const draft = cid ? { model: robot.model, objective: cid, cost, validator: zeroAddress, validatorFee: 0n, lifetime: market.defaultLifetime } : null;
  return (
    <div class="one-robot">
      <div class="row between"><span class="brand">AIRA</span><AccountControl /></div>
      <h1><Strange text={robot.title || description?.title || texts.undescribed} most={80} /></h1>
      <p class="lead"><Strange text={robot.text || description?.description || ""} most={1000} /></p>
      {robot.objective ? null : <Show of={model}>{(known) => <ObjectiveChoice model={known} objective={objective} choose={setObjective} />}</Show>}
      <p class="price">{amount(cost, market.token)}</p>
      {account ? <OrderButton draft={draft} /> : <p class="callout">{texts.connectFirst}</p>}
      {description?.success ? <p class="hint">{texts.successIs} <Strange text={plain(description.success)} /></p> : null}
    </div>
  );
}
