import { useEffect, useState } from "preact/hooks";
import { asProblem, type Problem } from "../api/problem";
import { go, query } from "../app/route";
import { signIn } from "../app/session";
import { Loading, ProblemBox } from "../ui/boxes";

/** Open a shared link: `#/shared/<token>?<state of the view>`. The token leaves the address at once. */
export function SharedPage({ token }: { token: string }) {
  const [problem, setProblem] = useState<Problem | null>(null);
  useEffect(() => {
    const view = Object.fromEntries(query.value);
    signIn({ share: token }).then(
      (made) => {
        history.replaceState(null, "", "#/");
        go(["view", made.cloud_id ?? ""], view);
      },
      (thrown: unknown) => setProblem(asProblem(thrown)),
    );
  }, [token]);
  return problem ? <ProblemBox problem={problem} /> : <Loading />;
}
