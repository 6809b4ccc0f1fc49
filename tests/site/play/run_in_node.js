// Runs cases of test_play.py by the files of the page: `node run_in_node.js FOLDER < CASES`; prints an answer for each.
"use strict";
const { createHash } = require("crypto");
const fs = require("fs");
const vm = require("vm");

for (const name of ["kernel.js", "graph.js"])
  vm.runInThisContext(fs.readFileSync(`${process.argv[2]}/${name}`, "utf8"), name);

const sums = (rows, names) => {
  const found = {};
  for (const name of names) {
    const { buffer, byteOffset, byteLength } = rows[name];
    found[name] = createHash("sha256").update(Buffer.from(buffer, byteOffset, byteLength)).digest("hex");
  }
  return found;
};

vm.runInThisContext(`
function play({ task, seed, actions, steps, count }) {
  const rows = new Rows(task, count, steps, seed);
  rows.reset();
  actions.forEach((action, place) => (rows.action[place] = BigInt(action)));
  rows.step(steps, true);
  return rows;
}
function answer(what, given) {
  if (what === "play") return { packed: [...packed(given.task)].map(String), rows: play(given) };
  const drawnGoals = (graph, count) => Array.from({ length: count }, () => drawnGoal(graph, Math.random));
  return { drawnGoals, refusal, closedForms, ceilings, performanceMatrix, leafOf }[what](...given);
}`);

const names = [
  "kind", "node", "tick", "step_count", "episode_reward", "reward", "paid", "observation", "following", "done", "outcome",
  "leaf", "steps", "rewards", "returns",
];
const answers = JSON.parse(fs.readFileSync(0, "utf8")).map(([what, given]) => {
  try {
    const found = vm.runInThisContext("answer")(what, given);
    return what === "play" ? { packed: found.packed, sums: sums(found.rows, names) } : found;
  } catch (error) {
    return { error: error.message };
  }
});
console.log(JSON.stringify(answers));
