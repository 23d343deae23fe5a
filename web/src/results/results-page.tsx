export default function Page({ parts }: { parts: readonly string[] }) { return <p class="page">{parts.join("/")}</p>; }
