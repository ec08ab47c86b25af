import { useMemo } from "preact/hooks";
import { zeroAddress } from "viem";
import { useApp, useData, useTyped } from "../app";
import { amount, plain } from "../format";
import { parseAmount } from "../numbers";
import type { Wish } from "../ordering";
import { texts } from "../texts";
import type { Model, Robot } from "../types";
import { Show, Strange } from "../ui";
import { AccountControl } from "./account";
import { ObjectiveChoice, firstChoice, objectiveOf, useObjective, withoutDescription } from "./objective";
import { OrderButton, typicalPrice } from "./order";

/** The page of one robot: what it does, what it costs, one button. Fit for a frame in another site. */
export function SinglePage({ robot }: { robot: Robot }) {
  const model = useData<Model>(`models/${robot.model}`);
  const description = model.data?.description;
  const hasObjective = robot.objective !== null;
  const known = useMemo(() => model.data ?? (hasObjective ? withoutDescription(robot.model) : null), [model.data, hasObjective, robot.model]);
  return (
    <div class="one-robot">
      <div class="row between"><span class="brand">AIRA</span><AccountControl /></div>
      <h1><Strange text={robot.title || description?.title || texts.undescribed} most={80} /></h1>
      <p class="lead"><Strange text={robot.text || description?.description || ""} most={1000} /></p>
      {robot.objective ? null : <Show of={model}>{() => null}</Show>}
      {known ? <RobotOrder key={`${robot.model} ${known.described}`} robot={robot} model={known} /> : null}
      {description?.success ? <p class="hint">{texts.successIs} <Strange text={plain(description.success)} /></p> : null}
    </div>
  );
}

function RobotOrder({ robot, model }: { robot: Robot; model: Model }) {
  const { market, account } = useApp();
  const [choice, setChoice] = useTyped(`choice ${model.described}`, () => firstChoice(model));
  const chosen = useObjective(model, choice);
  const cost = robot.cost !== null ? BigInt(robot.cost) : parseAmount(typicalPrice(model.description?.price, market.token.symbol), market.token.decimals) ?? 0n;
  const wish = useMemo<Wish | null>(() => {
    const objective = robot.objective ? () => objectiveOf(robot.objective!, model) : chosen;
    return objective && { model, robot: "" as const, objective, cost, validator: zeroAddress, validatorFee: 0n, minutes: null };
  }, [model, robot.objective, chosen, cost]);
  return (
    <>
      {robot.objective ? null : <ObjectiveChoice model={model} choice={choice} make={chosen} change={setChoice} />}
      <p class="price">{amount(cost, market.token)}</p>
      {account ? <OrderButton wish={wish} /> : <p class="callout">{texts.connectFirst}</p>}
    </>
  );
}
