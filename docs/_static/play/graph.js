// What the page knows of a CT-graph: its parameters, closed forms, and how the kernel's memory is filled.
// The dynamics are in kernel.js alone, which is made from ctgraph_rl/core/kernel.c.
"use strict";

const PRESETS = {
  "CT-FO-B1": { b: 2, d: 2, p: 0, shown: "full" },
  "CT-SU-B1": { b: 2, d: 2, p: 0, shown: "surjective" },
  "CT-CO-B1": { b: 2, d: 2, p: 0, shown: "confounding" },
  "CT-POSR-B1": { b: 2, d: 2, p: 0.5, shown: "surjective" },
  "CT-FO-B2": { b: 2, d: 3, p: 0.5, shown: "full" },
};

const KINDS = ["home", "wait", "decision", "end", "fail"];
const SHOWN = ["full", "surjective", "confounding"];
const OUTCOMES = ["running", "fail", "wrong end", "goal"];
const MOST = { b: 5, d: 8 };
const WAIT_IMAGES = 100; // of a confounding graph
const PIXELS = 144;

const bytesOf = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
const IMAGES = bytesOf(KERNEL.images);
const NUM_IMAGES = IMAGES.length / PIXELS;
const MODULE = new WebAssembly.Module(bytesOf(KERNEL.wasm));

// The number of an image among those of the paper.
function imageNumber(pixels) {
  for (let number = 0; number < NUM_IMAGES; number++)
    if (pixels.every((value, place) => value === IMAGES[number * PIXELS + place])) return number;
  throw new Error("the kernel showed no image of the paper");
}

const firstNode = (b, level) => (b ** level - 1) / (b - 1);

function sizes({ b, d }) {
  const ends = b ** d, decisions = firstNode(b, d);
  return { ends, decisions, waits: decisions + ends, states: 2 * (decisions + ends) + 2 };
}

// Why these parameters are refused, in a sentence; null for those that are not.
function refusal({ b, d, p, shown }) {
  const whole = (value, low, high) => Number.isInteger(value) && value >= low && value <= high;
  if (!whole(b, 2, MOST.b)) return `b must be an integer in 2..${MOST.b} on this page, got ${b}.`;
  if (!whole(d, 1, MOST.d)) return `d must be an integer in 1..${MOST.d} on this page, got ${d}.`;
  if (!(typeof p === "number" && p >= 0 && p < 1)) return `p must be in [0, 1), got ${p}.`;
  if (!SHOWN.includes(shown)) return `The observations must be ${SHOWN.join(", ")}, got ${shown}.`;
  const { states } = sizes({ b, d });
  if (shown === "full" && states > NUM_IMAGES)
    return `A fully observable graph needs an image for each of its ${states} states, and this page has ${NUM_IMAGES}: choose a smaller d, or surjective.`;
  return null;
}

// A goal of d decisions in 1..b, as digits, by random numbers in [0, 1). From d = 2 on two of them differ: a policy
// without memory that always takes one branch misses it.
function drawnGoal({ b, d }, random) {
  const digits = Array.from({ length: d }, () => 1 + Math.floor(random() * b));
  if (d > 1 && new Set(digits).size === 1) {
    const place = Math.floor(random() * d);
    digits[place] = 1 + (digits[place] + Math.floor(random() * (b - 1))) % b;
  }
  return digits.join("");
}

const leafOf = ({ b, goal }) => [...goal].reduce((leaf, digit) => leaf * b + Number(digit) - 1, 0);

function closedForms({ b, d, p }) {
  const { ends, states } = sizes({ b, d });
  const reward = (b + 1) * ((1 - p) / ((b + 1) * (b + 1 - p))) ** (d + 1);
  return {
    states,
    rewardProb: reward,
    endProb: ends * reward,
    navigationProb: 1 / ends,
    length: (d + 1) / (1 - p) + d + 1,
    search: (ends + 1) / 2,
  };
}

// The best success rate of a policy without memory that draws its decisions, and of one that does not.
function ceilings({ d, shown, goal }) {
  if (shown === "full") return { drawn: 1, fixed: 1 };
  const counts = {};
  for (const digit of goal) counts[digit] = (counts[digit] || 0) + 1;
  const drawn = Object.values(counts).reduce((product, n) => product * (n / d) ** n, 1);
  return { drawn, fixed: Object.keys(counts).length === 1 ? 1 : 0 };
}

// The first image and the number of images of each kind of state, in the order of KINDS.
function imagesOf({ b, d, shown }) {
  const { ends, decisions, waits } = sizes({ b, d });
  if (shown === "full") return { first: [0, 2, 2 + waits, 2 + waits + decisions, 1], drawn: [1, 1, 1, 1, 1] };
  const drawn = shown === "confounding" ? WAIT_IMAGES : 1;
  return { first: [0, 3, 2, 3 + drawn, 1], drawn: [1, drawn, 1, 1, 1] };
}

// The fields of `Task` in kernel.c, of eight bytes each.
function packed(task) {
  const { ends, decisions } = sizes(task), { first, drawn } = imagesOf(task);
  const made = new BigInt64Array(46), real = new Float64Array(made.buffer);
  const full = task.shown === "full", firstView = [...first];
  if (full) firstView[3] -= decisions; // the first end state is node number `decisions`
  const stays = BigInt(Math.floor(task.p * 2 ** 63));
  const whole = [task.b, decisions, stays, 0, -1, -1, -1, 1, 1, 0, 0, 0, 11, 0, 0, task.d, ends];
  whole.forEach((value, place) => (made[place] = BigInt(value)));
  real[14] = 254; // white
  real[22] = 1; // what the goal pays
  for (let kind = 0; kind < 5; kind++) {
    made[26 + kind] = BigInt(firstView[kind]);
    made[31 + kind] = BigInt(full && kind > 0 && kind < 4 ? 1 : 0);
    made[36 + kind] = BigInt(drawn[kind]);
    made[41 + kind] = 1n;
  }
  return made;
}

// The fields of `Call` in kernel.c: numbers of eight bytes, then pointers of four.
const NUMBERS = [
  "num_rows", "num_steps", "num_threads", "num_tasks", "bank_rows", "num_pixels", "width", "is_vector", "num_levels",
  "draws", "pixel_noise", "noise_bank", "reward_noise", "fail_reward", "step_reward", "goal_change", "own_seeds",
  "restarts", "most_action",
];
const STATE = [
  "kind", "node", "tick", "step_count", "episode_reward", "goal_leaf", "episodes_left", "reward", "paid",
];
const POINTERS = [
  "tasks", "task", "seed", "row", "bank", "noises", "normal_table", "level_first", "level_shift", "tap_index",
  "tap_weight", ...STATE, ...STATE, "action", "mask", "shown", "observation", "following", "done", "outcome",
  "leaf", "steps", "rewards", "returns",
];

// Rows that play one task each with its number as the row of the random streams, as `Rows` does in Python.
class Rows {
  constructor(task, count = 1, mostSteps = 1, seed = 0) {
    const { memory, malloc, ctgraph_run } = new WebAssembly.Instance(MODULE).exports;
    const all = count * mostSteps;
    const sizesOf = {
      tasks: [BigInt64Array, 46], task: [BigInt64Array, count], seed: [BigInt64Array, 1], row: [BigInt64Array, count],
      bank: [Uint8Array, IMAGES.length], kind: [Uint8Array, count], node: [BigInt64Array, count],
      tick: [BigInt64Array, count], step_count: [BigInt64Array, count], episode_reward: [Float32Array, count],
      goal_leaf: [BigInt64Array, count], episodes_left: [BigInt64Array, count], reward: [Float32Array, count],
      paid: [Float32Array, count], action: [BigInt64Array, all], mask: [Uint8Array, count],
      observation: [Uint8Array, all * PIXELS], following: [Uint8Array, all * PIXELS], done: [Uint8Array, all],
      outcome: [Uint8Array, all], leaf: [BigInt64Array, all], steps: [BigInt64Array, all],
      rewards: [Float32Array, all], returns: [Float32Array, all],
    };
    this.places = { call: malloc(8 * NUMBERS.length + 4 * POINTERS.length) };
    for (const [name, [Kind, length]] of Object.entries(sizesOf))
      this.places[name] = malloc(Kind.BYTES_PER_ELEMENT * length);
    this.memory = memory; // views are made now: a further malloc would end them
    for (const [name, [Kind, length]] of Object.entries(sizesOf))
      this[name] = new Kind(memory.buffer, this.places[name], length).fill(Kind === BigInt64Array ? 0n : 0);
    this.run = ctgraph_run;
    this.count = count;
    this.draws = task.p > 0 || task.shown === "confounding";
    this.tasks.set(packed(task));
    this.seed[0] = BigInt(seed);
    this.bank.set(IMAGES);
    this.goal_leaf.fill(BigInt(leafOf(task)));
    this.mask.fill(1);
    for (let number = 0; number < count; number++) this.row[number] = BigInt(number);
  }

  // Let all rows start an episode.
  reset() {
    this.call({ num_steps: 1, restarts: 0 }, ["mask", "observation"]);
  }

  // Take the steps whose actions are set; with `restarts` rows that are over start an episode within the step.
  step(numSteps = 1, restarts = false) {
    const outputs = ["observation", "done", "outcome", "leaf", "steps", "rewards", "returns"];
    this.call({ num_steps: numSteps, restarts: Number(restarts) }, ["action", ...outputs, ...(restarts ? ["following"] : [])]);
  }

  call(how, arrays) {
    const given = {
      num_rows: this.count, num_threads: 1, num_tasks: 1, bank_rows: NUM_IMAGES, num_pixels: PIXELS, width: 12,
      draws: Number(this.draws), most_action: -1, ...how,
    };
    const used = new Set(["tasks", "task", "seed", "row", "bank", ...STATE, ...arrays]);
    const view = new DataView(this.memory.buffer, this.places.call);
    NUMBERS.forEach((name, place) => view.setBigInt64(8 * place, BigInt(given[name] || 0), true));
    POINTERS.forEach((name, place) =>
      view.setUint32(8 * NUMBERS.length + 4 * place, used.has(name) ? this.places[name] : 0, true));
    if (this.run(this.places.call) !== 0n) throw new Error("the kernel met a state that this graph does not have");
  }
}

// The interval of Wilson for a share, at 95 %.
function interval(hits, count) {
  const z = 1.959963984540054, share = hits / count, scale = 1 + z * z / count;
  const middle = (share + z * z / (2 * count)) / scale;
  const half = z * Math.sqrt(share * (1 - share) / count + z * z / (4 * count * count)) / scale;
  return [Math.max(0, middle - half), Math.min(1, middle + half)];
}

// The goal in the label of a task, "12" for "depth2, goal1.2"; empty without one.
function goalIn(label) {
  const found = /goal((?:\d\.)*\d)(?![\d.])/.exec(label);
  return found ? found[1].replaceAll(".", "") : "";
}

// The share of episodes that ended in each end state of a tree: at the goal as a log says, else in equal parts.
function visitsOf({ success_rate: goal, end_rate: end }, tree) {
  const count = tree.b ** tree.d;
  const visits = new Float64Array(count).fill((end - goal) / (count - 1));
  visits[leafOf(tree)] = goal;
  return visits;
}

// Where the episodes of an evaluation ended, in words.
function endsOf({ success_rate: goal, end_rate: end }) {
  if (typeof goal !== "number" || typeof end !== "number") return "";
  const percent = (share) => `${Math.round(100 * share)} %`;
  return `goal ${percent(goal)},\nother ends ${percent(end - goal)},\nfail ${percent(1 - end)}`;
}

// What a run.jsonl says: names of tasks, and after each block the mean return on each task and where episodes ended.
function performanceMatrix(text) {
  const lines = text.split("\n"), measured = [];
  if (lines[lines.length - 1] !== "") lines.pop(); // torn, as the run was killed while it wrote
  lines.filter((line) => line).forEach((line, place) => {
    let found = null;
    try { found = JSON.parse(line); } catch { /* said below */ }
    if (!found || typeof found.kind !== "string") throw new Error(`This is no log of a run: line ${place + 1} is no measurement.`);
    measured.push(found);
  });
  if (!measured.length || measured[0].kind !== "run") throw new Error("This is no log of a run: its first line does not say what was run.");
  const own = measured.filter((m) => m.kind === "evaluation" && m.moment !== "during" && !m.held_out);
  if (!own.length) throw new Error("This log has no evaluation yet.");
  const tasks = [...new Set(own.map((m) => m.task))].sort((a, b) => a - b), rows = [];
  for (const m of own) {
    const row = rows.find((each) => each.block === m.block) || rows[rows.push({ block: m.block, frames: m.frames, returns: {}, ends: {}, measured: {} }) - 1];
    row.returns[m.task] = m.return_mean;
    row.measured[m.task] = m;
    row.ends[m.task] = endsOf(m);
  }
  const labels = tasks.map((task) => String((own.find((m) => m.task === task) || {}).label || `task ${task}`));
  return { name: String(measured[0].curriculum), tasks, labels, rows };
}
