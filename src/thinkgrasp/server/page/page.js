"use strict";
// The page on which a person tries the server: files and a sentence go to /v1/explain, what comes back is shown.

const $ = (id) => document.getElementById(id);
const files = { color: null, depth: null, camera: null };
const HEADLINES = { grasp: "GRASP", no_grasp: "NO GRASP", no_target: "NO TARGET" };
const NUMBERS = ["fx", "fy", "cx", "cy", "depth_scale"];
let shown = null;

function element(tag, text, className) {
  const made = document.createElement(tag);
  if (text !== undefined) made.textContent = text;
  if (className) made.className = className;
  return made;
}

// What a file is by its name and type; null where that does not say.
function roleOf(file) {
  const name = file.name.toLowerCase();
  if (name.endsWith(".json")) return "camera";
  if (name.includes("depth") || name.endsWith(".npy") || /\.tiff?$/.test(name)) return "depth";
  if (name.includes("color") || name.includes("colour") || name.includes("rgb") || /\.(jpe?g|webp|bmp)$/.test(name)) return "color";
  return null;
}

function take(role, file) {
  files[role] = file;
  const drop = document.querySelector(`.drop[data-role=${role}]`);
  drop.classList.add("full");
  drop.querySelector(".file").textContent = file.name;
  const picture = drop.querySelector("img");
  if (role === "color" && picture) {
    if (picture.src) URL.revokeObjectURL(picture.src);
    picture.src = URL.createObjectURL(file);
    picture.hidden = false;
    picture.onerror = () => { picture.hidden = true; };
  }
  complain("");
}

// Several files dropped at once go where their names say, the rest where there is room.
function takeAll(role, dropped) {
  const list = [...dropped];
  if (list.length === 1) return take(role, list[0]);
  const rest = [];
  for (const file of list) {
    const own = roleOf(file);
    if (own) take(own, file); else rest.push(file);
  }
  for (const file of rest) take(files.color ? "depth" : "color", file);
}

function complain(text) {
  $("problem").textContent = text;
  $("problem").hidden = !text;
}

async function readCamera() {
  const typed = {};
  for (const name of NUMBERS) {
    const text = $("form").elements[name].value.trim().replace(",", ".");
    if (!text) continue;
    const value = Number(text);
    if (!Number.isFinite(value)) throw new Error(`${name} must be a number, got "${text}"`);
    typed[name] = value;
  }
  if (files.camera) {
    let camera;
    try { camera = JSON.parse(await files.camera.text()); } catch { throw new Error("The camera file is not readable as JSON."); }
    return { ...camera, ...typed };
  }
  const missing = ["fx", "fy", "cx", "cy"].filter((name) => !(name in typed));
  if (missing.length) {
    $("numbers").open = true;
    throw new Error(`Add the camera file, or type ${missing.join(", ")}.`);
  }
  return typed;
}

async function ask(event) {
  event.preventDefault();
  complain("");
  try {
    if (!files.color) throw new Error("Add the colour image.");
    if (!files.depth) throw new Error("Add the depth image.");
    const instruction = $("instruction").value.trim() || $("instruction").placeholder;
    const body = new FormData();
    body.append("color", files.color);
    body.append("depth", files.depth);
    body.append("camera", JSON.stringify(await readCamera()));
    body.append("instruction", instruction);
    busy(true);
    const token = $("token").value.trim();
    const answer = await fetch("v1/explain", { method: "POST", body, headers: token ? { Authorization: `Bearer ${token}` } : {} });
    const data = await answer.json();
    if (answer.status === 401) $("token-row").hidden = false;
    if (!answer.ok) throw new Error(data.error?.message ?? `The server answered ${answer.status}.`);
    show(data);
  } catch (error) {
    $("result").hidden = true;  // it answers another question
    complain(error instanceof TypeError ? "The server does not answer." : error.message);
  } finally {
    busy(false);
  }
}

function busy(is) {
  $("go").disabled = is;
  $("go").textContent = is ? "Deciding…" : "Find a grasp";
}

function show({ decision, overlay_png, view_html }) {
  const { plan, target, grasp } = decision;
  $("result").hidden = false;  // first, so that the 3-D view finds its size
  $("status").textContent = HEADLINES[decision.status];
  $("status").className = `status ${decision.status}`;
  $("headline").textContent = decision.instruction;
  $("why").textContent = plan.rationale;
  $("overlay").src = `data:image/png;base64,${overlay_png}`;
  // The picture's caption and the 3-D page's panel would repeat what stands around them.
  const picture = document.querySelector(".drop[data-role=color] img");
  $("overlay").style.aspectRatio = picture.naturalWidth ? `${picture.naturalWidth} / ${picture.naturalHeight}` : "auto";
  $("view").srcdoc = view_html.replace("</head>", "<style>aside,.hint{display:none}main{flex:1!important;height:100%!important}</style></head>");
  if (shown) URL.revokeObjectURL(shown);
  shown = URL.createObjectURL(new Blob([view_html], { type: "text/html" }));
  $("whole").href = shown;

  const facts = [];
  if (decision.status !== "no_target") {
    facts.push(["Take", plan.target], ["It is", plan.role === "goal" ? "the goal" : "in the way of the goal"]);
    if (plan.mark !== null) facts.push(["Mark", plan.mark]);
    facts.push(["Cell", `${plan.cell} of ${plan.grid} × ${plan.grid}`]);
  }
  if (target) facts.push(["Match", target.score.toFixed(2)]);
  if (grasp) {
    facts.push(["Position", `${grasp.position_m.map((v) => v.toFixed(3)).join(", ")} m`]);
    facts.push(["Frame", grasp.frame], ["Opening", `${(grasp.width_m * 1000).toFixed(0)} mm`], ["Grasp score", grasp.score.toFixed(2)]);
    facts.push(["Alternatives", decision.alternatives.length]);
  }
  if (decision.usage.model) facts.push(["Model", `${decision.usage.model}, ${decision.usage.prompt_tokens + decision.usage.completion_tokens} tokens`]);
  $("plan").replaceChildren(...facts.flatMap(([name, value]) => [element("dt", name), element("dd", String(value))]));
  if (!facts.length) $("plan").replaceChildren(element("dt", "Nothing in view fits."));

  const first = Math.max(1, decision.funnel[0]?.in ?? 0);
  bars($("funnel"), decision.funnel.map((step) => [step.check, step.out, step.out / first]), "No grasps were proposed.");
  const times = Object.entries(decision.timings_ms).filter(([, ms]) => ms > 0);
  const total = Math.max(decision.timings_ms.total, 1e-9);
  bars($("times"), times.map(([name, ms]) => [name, `${ms.toFixed(0)} ms`, ms / total]), "Nothing was timed.");
  $("fallbacks-row").hidden = !decision.degraded.length;
  $("fallbacks").replaceChildren(...decision.degraded.map((d) => element("li", `${d.stage}: ${d.reason}; instead: ${d.fallback}`)));
  const short = { ...decision, target: target && { ...target, mask_png: target.mask_png && `${target.mask_png.slice(0, 24)}…` } };
  $("json").textContent = JSON.stringify(short, null, 2);
  $("result").scrollIntoView({ behavior: "smooth", block: "start" });
}

function bars(table, rows, otherwise) {
  if (!rows.length) return table.replaceChildren(element("caption", otherwise, "quiet"));
  table.replaceChildren(...rows.map(([name, value, share]) => {
    const row = element("tr"), bar = element("td", undefined, "bar"), fill = element("i");
    fill.style.width = `${100 * Math.min(Math.max(share, 0), 1)}%`;
    bar.append(fill);
    row.append(element("th", name.replaceAll("_", " ")), bar, element("td", String(value)));
    return row;
  }));
}

async function watchReadiness() {
  try {
    const answer = await fetch("readyz");
    $("ready").textContent = answer.ok ? "ready" : "loading";
    $("ready").className = `ready ${answer.ok ? "yes" : ""}`;
  } catch {
    $("ready").textContent = "no answer";
    $("ready").className = "ready no";
  }
  setTimeout(watchReadiness, 5000);
}

for (const drop of document.querySelectorAll(".drop")) {
  const role = drop.dataset.role, input = drop.querySelector("input");
  input.addEventListener("change", () => { if (input.files.length) takeAll(role, input.files); });
  drop.addEventListener("dragover", (event) => { event.preventDefault(); drop.classList.add("over"); });
  drop.addEventListener("dragleave", () => drop.classList.remove("over"));
  drop.addEventListener("drop", (event) => {
    event.preventDefault();
    event.stopPropagation();
    drop.classList.remove("over");
    if (event.dataTransfer.files.length) takeAll(role, event.dataTransfer.files);
  });
}
// A file that misses its field must not replace the page.
document.addEventListener("dragover", (event) => event.preventDefault());
document.addEventListener("drop", (event) => {
  event.preventDefault();
  for (const file of event.dataTransfer.files) take(roleOf(file) ?? (files.color ? "depth" : "color"), file);
});
$("form").addEventListener("submit", ask);
watchReadiness();
