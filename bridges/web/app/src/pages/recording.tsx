import { Replay } from "../live";
import { texts } from "../texts";
import { Name } from "../ui";

export function FilePage(props: { cid: string }) {
  return (
    <>
      <h1>{texts.fileTitle} <Name text={props.cid} /></h1>
      <Replay cid={props.cid} model={null} />
    </>
  );
}
