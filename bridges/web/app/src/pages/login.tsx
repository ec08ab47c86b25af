import { useState } from "preact/hooks";
import { post } from "../api";
import { wordsOf } from "../app";
import { texts } from "../texts";
import { Field } from "../ui";

/** Logs in with a token: people where the server asks for it, operators anywhere. */
export function LoginForm(props: { label: string; hint?: string; done: () => void }) {
  const [token, setToken] = useState("");
  const [error, setError] = useState("");
  const logIn = (event: Event) => {
    event.preventDefault();
    setError("");
    post("session", { token }).then(props.done, (problem) => setError(wordsOf(problem)));
  };
  return (
    <form class="row end" onSubmit={logIn}>
      <Field label={props.label} hint={props.hint} error={error}>
        {(id, described) => <input id={id} aria-describedby={described} type="password" autocomplete="current-password" value={token} onInput={(event) => setToken(event.currentTarget.value)} />}
      </Field>
      <button class="button" disabled={!token}>{texts.logIn}</button>
    </form>
  );
}
