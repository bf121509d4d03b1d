// The canvas's WebGL context and the first picture's data: begun before three.js is there, since both take their time.
export const context = document.getElementById("canvas")
  .getContext("webgl2", { antialias: true, alpha: false, powerPreference: "high-performance" });

export async function fetched(address, kind) {
  const answer = await fetch(address);
  if (!answer.ok) throw new Error((await answer.text()) || `${address}: ${answer.status}`);
  return answer[kind]();
}

export const firstFile = context ? fetched("data/first.glb", "arrayBuffer") : Promise.resolve(null);
firstFile.catch(() => {}); // whoever waits for it hears of it
