// Questions to the server and their answers: each resolves to the answer, or to {error} with the reason.

export const get = (path) => post(path, undefined, "GET");

export async function post(path, body, method = "POST") {
  try {
    const answer = await fetch(path, { method, headers: { "Content-Type": "application/json" }, body: JSON.stringify(body) });
    const text = await answer.text();
    return answer.headers.get("content-type")?.includes("json") ? (JSON.parse(text) ?? {}) : { error: text.trim() };
  } catch {
    return { error: "Nisus does not answer" };
  }
}
