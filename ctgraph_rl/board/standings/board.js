"use strict";
// Tables are sorted by a click on a heading and filtered by the controls; without this file they are plain tables.
document.documentElement.classList.add("scripted");
const controls = document.getElementById("controls");
const wanted = name => controls.elements[name].value;

function filter() {
  const most = name => wanted(name) === "" ? Infinity : Number(wanted(name));
  for (const section of document.querySelectorAll("section.track")) {
    const given = wanted("given") === "" || section.dataset.given === wanted("given");
    let shown = 0;
    for (const row of section.querySelectorAll("table.board tbody tr")) {
      row.hidden = !(given && Number(row.dataset.level) >= Number(wanted("level"))
        && Number(row.dataset.bytes) <= most("bytes") && Number(row.dataset.steps) <= most("steps"));
      shown += !row.hidden;
    }
    section.hidden = shown === 0;
  }
  document.getElementById("none").hidden = document.querySelector("section.track:not([hidden])") !== null;
}

function compare(one, other, sign) {
  if (one === other) return 0;
  if (one === "" || other === "") return one === "" ? 1 : -1;
  const [a, b] = [Number(one), Number(other)];
  return sign * (Number.isNaN(a) || Number.isNaN(b) ? one.localeCompare(other) : a - b);
}

function sort(heading) {
  const place = [...heading.parentNode.children].indexOf(heading);
  const rises = heading.getAttribute("aria-sort") !== "ascending";
  for (const other of heading.parentNode.children) other.removeAttribute("aria-sort");
  heading.setAttribute("aria-sort", rises ? "ascending" : "descending");
  const body = heading.closest("table").tBodies[0];
  const value = row => row.children[place].dataset.value;
  [...body.rows].sort((one, other) => compare(value(one), value(other), rises ? 1 : -1))
    .forEach(row => body.append(row));
}

controls.hidden = false;
controls.addEventListener("input", filter);
controls.addEventListener("reset", () => setTimeout(filter));
controls.addEventListener("submit", event => event.preventDefault());
for (const button of document.querySelectorAll("table.board thead button")) {
  button.addEventListener("click", () => sort(button.closest("th")));
}
