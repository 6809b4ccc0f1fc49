// The page "Play and explore": form, tree, image, numbers, simulation and logs. graph.js has what it shows.
"use strict";

const at = (id) => document.getElementById(`ct-${id}`);
const ROWS = 256, STEPS = 64; // of the simulation, at a time
const MOST_DRAWN = 64; // nodes side by side in the picture of the tree
const SVG = "http://www.w3.org/2000/svg";

let task = null; // what is played; its goal is drawn and stays hidden
let score = null; // episodes that count, those at the goal, and whether the present one counts
let rows = null; // one row of the kernel
let run = null; // the simulation: rows of the kernel and what was counted

const rounded = (number) => String(Number(number.toPrecision(4)));
const grouped = (number) => number.toLocaleString("en");

function placed(kind, node) {
  return kind === "home" || kind === "fail" ? `the ${kind} state` : `the ${kind} state of node ${node}`;
}

function element(name, attributes, parent) {
  const made = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  return parent.appendChild(made);
}

function say(id, text) {
  at(id).textContent = text;
}

// The parameters in the form.
function given() {
  const number = (id) => (at(id).value.trim() === "" ? NaN : Number(at(id).value));
  return { b: number("b"), d: number("d"), p: number("p"), shown: at("shown").value };
}

function fill(values) {
  for (const [name, value] of Object.entries(values)) at(name).value = value;
}

// Take the parameters of the form, or say why not.
function choose() {
  const wanted = given(), why = refusal(wanted);
  say("refusal", why || "");
  if (why) return;
  const same = Object.entries(PRESETS).find(([, each]) => JSON.stringify(each) === JSON.stringify(wanted));
  at("preset").value = same ? same[0] : "";
  history.replaceState(null, "", `#${new URLSearchParams(wanted)}`);
  play(wanted);
}

// Play a graph with a new goal, from the first episode on.
function play(graph) {
  task = { ...graph, goal: drawnGoal(graph, Math.random) };
  rows = new Rows(task, 1, 1, Math.floor(Math.random() * 2 ** 31));
  score = { episodes: 0, goals: 0, counts: true };
  stop();
  run = null;
  at("actions").replaceChildren(...Array.from({ length: task.b + 1 }, (_, action) => button(action)));
  showNumbers();
  showScore();
  showRun();
  begin();
}

function button(action) {
  const made = document.createElement("button");
  made.type = "button";
  made.textContent = action ? `${action}: branch ${action}` : "0: wait";
  made.addEventListener("click", () => act(action));
  return made;
}

function begin() {
  rows.reset();
  rows.outcome[0] = 0;
  score.counts = !at("reveal").checked;
  say("outcome", "A new episode begins at the home state: any action leaves it.");
  show();
}

function act(action) {
  if (!rows || action > task.b || rows.outcome[0]) return;
  rows.action[0] = BigInt(action);
  rows.step();
  const reward = rows.rewards[0], outcome = OUTCOMES[rows.outcome[0]], steps = rows.steps[0];
  say("outcome", outcome === "running"
    ? `Action ${action}, step ${steps}, reward ${reward}. You see image ${imageNumber(rows.observation)}.`
    : `The episode ends after ${steps} steps: ${outcome}, reward ${reward}. Press n for a new one.`);
  if (rows.outcome[0] && score.counts) {
    score.episodes++;
    if (outcome === "goal") score.goals++;
    showScore();
  }
  show();
}

// The image, the buttons, and what is hidden from a policy.
function show() {
  const context = at("image").getContext("2d"), image = context.createImageData(12, 12);
  for (let pixel = 0; pixel < PIXELS; pixel++)
    image.data.set([...Array(3).fill(rows.observation[pixel]), 255], 4 * pixel);
  context.putImageData(image, 0, 0);
  at("image").setAttribute("aria-label", `The agent sees image ${imageNumber(rows.observation)}`);
  // `disabled` would take the focus from the button that ended the episode
  for (const each of at("actions").children) each.setAttribute("aria-disabled", String(rows.outcome[0] !== 0));
  const kind = KINDS[rows.kind[0]], node = Number(rows.node[0]);
  const shows = at("reveal").checked;
  if (shows) score.counts = false;
  const goal = [...task.goal].join(".");
  say("hidden", shows ? `You are at ${placed(kind, node)}. The goal is ${goal}. This episode does not count.` : "");
  drawTree();
}

// Own successes beside exact success rates; those that depend on the goal appear once it was reached.
function showScore() {
  const { episodes, goals } = score;
  const share = episodes ? `${rounded(goals / episodes)} (${grouped(goals)} of ${grouped(episodes)})` : "no episode yet";
  say("own", share);
  const { drawn, fixed } = ceilings(task);
  say("drawn", goals ? rounded(drawn) : "after your first success");
  say("fixed", goals ? rounded(fixed) : "after your first success");
}

function drawTree() {
  const { b, d } = task, reveal = at("reveal").checked;
  let levels = d;
  while (b ** levels > MOST_DRAWN) levels--;
  const svg = at("tree"), here = Number(rows.node[0]), kind = KINDS[rows.kind[0]];
  const share = (number) => run.visits[number] / run.ends;
  drawNodes(svg, task, levels, reveal, run && run.ends ? share : null, (mark, node) => {
    if (reveal && node === here && kind !== "home" && kind !== "fail") mark.classList.add("here");
  });
  for (const [name, x] of [["home", 150], ["fail", 250]]) {
    const mark = element("text", { x, y: 16, "text-anchor": "middle" }, svg);
    mark.textContent = name;
    if (reveal && kind === name) mark.classList.add("here");
  }
  const place = reveal ? ` You are at ${placed(kind, here)}.` : "";
  svg.setAttribute("aria-label", `The tree of ${grouped(b ** d)} end states.${place}`);
  say("depth", levels < d ? `The picture ends at level ${levels} of ${d}.` : "");
}

// Draw a tree to a level; end states are fuller where `share` is above that of equal parts.
function drawNodes(svg, { b, d, goal }, levels, reveal, share, look) {
  svg.replaceChildren();
  svg.setAttribute("viewBox", `0 0 400 ${60 + 50 * levels}`);
  const place = (level, number) => [400 * (number + 0.5) / b ** level, 40 + 50 * level];
  const onGoal = (level, number) => number === Math.floor(leafOf({ b, d, goal }) / b ** (d - level));
  for (let level = 0; level <= levels; level++)
    for (let number = 0; number < b ** level; number++) {
      const [x, y] = place(level, number);
      if (level) {
        const [x2, y2] = place(level - 1, Math.floor(number / b));
        const line = element("line", { x1: x, y1: y, x2, y2 }, svg);
        if (reveal && onGoal(level, number)) line.classList.add("goal");
      }
      const mark = element("circle", { cx: x, cy: y, r: level === d ? 5 : 7 }, svg);
      if (level === d && share) mark.style.fillOpacity = Math.min(1, share(number) * b ** d / 2);
      if (level === d && reveal && onGoal(level, number)) mark.classList.add("goal");
      look(mark, firstNode(b, level) + number);
    }
}

// Draw where the episodes of an evaluation of a log ended.
function showVisits(measured, tree, words) {
  const visits = visitsOf(measured, tree);
  const picture = at("visits");
  picture.removeAttribute("hidden");
  drawNodes(picture, tree, tree.d, true, (number) => visits[number], () => {});
  const others = "other end states have equal parts of what did not";
  picture.setAttribute("aria-label", `The tree of ${grouped(visits.length)} end states. ${words}`);
  say("ends", `${words} End states are fuller where episodes ended more often; a log counts those at the goal, and ${others}.`);
  picture.scrollIntoView({ block: "nearest" });
}

function showNumbers() {
  const forms = closedForms(task);
  const values = {
    states: grouped(forms.states), rewardProb: rounded(forms.rewardProb), endProb: rounded(forms.endProb),
    navigationProb: rounded(forms.navigationProb), length: rounded(forms.length),
    search: grouped(forms.search), random: rounded(forms.rewardProb),
  };
  for (const [name, value] of Object.entries(values)) say(name, value);
}

// Random episodes by the kernel: those of one picture of the screen.
function simulate() {
  if (!run || !run.on) return;
  const { b } = task, actions = new Int32Array(run.rows.action.buffer, run.rows.action.byteOffset, 2 * ROWS * STEPS);
  for (let place = 0; place < actions.length; place += 2) actions[place] = Math.floor(Math.random() * (b + 1));
  run.rows.step(STEPS, true);
  for (let place = 0; place < ROWS * STEPS; place++) {
    const outcome = run.rows.outcome[place];
    if (!outcome) continue;
    run.episodes++;
    if (outcome === 3) run.goals++;
    if (outcome > 1) {
      run.ends++;
      run.visits[Number(run.rows.leaf[place])]++;
    }
  }
  showRun();
  drawTree();
  requestAnimationFrame(simulate);
}

function showRun() {
  if (!run || !run.episodes) {
    say("measured", "");
    return;
  }
  const [low, high] = interval(run.goals, run.episodes), { rewardProb } = closedForms(task);
  say("measured", `${grouped(run.goals)} of ${grouped(run.episodes)} random episodes reach the goal, a share of `
    + `${rounded(run.goals / run.episodes)}, at 95 % between ${rounded(low)} and ${rounded(high)}. `
    + `The closed form is ${rounded(rewardProb)}.`);
}

function stop() {
  if (run) run.on = false;
  say("simulate", "Simulate random episodes");
}

function toggle() {
  if (run && run.on) return stop();
  if (!run) {
    run = { rows: new Rows(task, ROWS, STEPS, Math.floor(Math.random() * 2 ** 31)), episodes: 0, goals: 0, ends: 0 };
    run.visits = new Float64Array(task.b ** task.d);
    run.rows.reset();
  }
  run.on = true;
  say("simulate", "Stop the simulation");
  requestAnimationFrame(simulate);
}

// The performance matrix of a log: a row for each block, brighter cells for higher returns.
async function showLog(file) {
  const table = at("matrix");
  table.replaceChildren();
  at("visits").setAttribute("hidden", "");
  say("ends", "");
  try {
    const { name, tasks, labels, rows: blocks } = performanceMatrix(await file.text());
    say("log", `${file.name}: ${name}. Mean return on each task after each block, and where episodes ended; nothing left this browser.`);
    const cell = (row, text, kind = "td") => {
      const made = row.appendChild(document.createElement(kind));
      made.textContent = text;
      return made;
    };
    const header = table.insertRow();
    for (const label of ["block", "frames", ...labels]) cell(header, label, "th").scope = "col";
    const goals = labels.map(goalIn);
    const b = Math.max(2, ...goals.join(""));
    for (const { block, frames, returns, ends, measured } of blocks) {
      const row = table.insertRow();
      cell(row, block, "th").scope = "row";
      cell(row, grouped(frames));
      for (const [place, task] of tasks.entries()) {
        const made = cell(row, returns[task] ?? "not measured");
        const goal = goals[place];
        made.style.setProperty("--share", Math.max(0, Math.min(1, returns[task] || 0)));
        if (ends[task]) made.appendChild(document.createElement("small")).textContent = ends[task];
        if (!ends[task] || !goal || b ** goal.length > MOST_DRAWN) continue;
        const tree = made.appendChild(document.createElement("button"));
        tree.type = "button";
        tree.textContent = "tree";
        const words = `${labels[place]} after ${grouped(frames)} frames: ${ends[task].replaceAll("\n", " ")}.`;
        tree.setAttribute("aria-label", `tree of ${words}`);
        tree.addEventListener("click", () => showVisits(measured[task], { b, d: goal.length, goal }, words));
      }
    }
  } catch (error) {
    say("log", `${file.name}: ${error.message}`);
  }
}

function start() {
  for (const name of ["b", "d", "p", "shown"]) at(name).addEventListener("change", choose);
  at("preset").addEventListener("change", () => {
    if (!at("preset").value) return;
    fill(PRESETS[at("preset").value]);
    choose();
  });
  at("new").addEventListener("click", begin);
  at("another").addEventListener("click", () => play(task));
  at("reveal").addEventListener("change", show);
  at("simulate").addEventListener("click", toggle);
  at("file").addEventListener("change", () => at("file").files.length && showLog(at("file").files[0]));
  at("drop").addEventListener("dragover", (event) => event.preventDefault());
  at("drop").addEventListener("drop", (event) => {
    event.preventDefault();
    if (event.dataTransfer.files.length) showLog(event.dataTransfer.files[0]);
  });
  document.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || event.target.closest?.("input, select, textarea")) return;
    if (/^[0-9]$/.test(event.key)) act(Number(event.key));
    if (event.key === "n") begin();
  });
  const linked = Object.fromEntries(new URLSearchParams(location.hash.slice(1)));
  fill(PRESETS["CT-FO-B1"]);
  for (const name of ["b", "d", "p", "shown"]) if (name in linked) at(name).value = linked[name];
  choose();
  if (!task) play(PRESETS["CT-FO-B1"]); // the link is refused: its message stays
}

start();
