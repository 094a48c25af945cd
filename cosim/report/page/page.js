"use strict";
(() => {
  const read = (id) => JSON.parse(document.getElementById(id).textContent);
  const data = read("data");
  const one = (selector, root = document) => root.querySelector(selector);
  const all = (selector, root = document) => [...root.querySelectorAll(selector)];

  // Plots
  const base = {
    font: { family: getComputedStyle(document.body).fontFamily, size: 13, color: "#3d454d" },
    margin: { l: 10, r: 14, t: 6, b: 44 }, paper_bgcolor: "#fff", plot_bgcolor: "#fff", hovermode: "closest",
    legend: { orientation: "h", x: 0, y: 1, xanchor: "left", yanchor: "bottom", traceorder: "normal" },
    hoverlabel: { bgcolor: "#16191d", bordercolor: "#16191d", font: { color: "#fff" } },
  };
  const axis = { gridcolor: "#e9ecee", automargin: true, fixedrange: true, title: { standoff: 8 } };
  const config = { responsive: true, displayModeBar: false };
  // Names are folded to the width that there is, and a plot is as high as its folded names need.
  function plot(place) {
    const { data: traces, layout } = data.plots[Number(place.dataset.plot)], wide = place.clientWidth;
    const rows = [...new Set(layout.yaxis.categoryarray || traces.flatMap((t) => t.y))];
    const names = rows.map((row) => folded(row, Math.max(10, Math.floor(0.36 * wide / LETTER))));
    const beside = Math.floor(wide / LETTER) - Math.max(...names.map(longest)) - 8;
    const keys = traces.map((t) => folded(t.name, Math.max(10, beside)));
    const taller = Math.max(0, LINE * Math.max(...names.map(lines)) + 8 - layout.meta.row) * rows.length;
    const inARow = Math.max(1, Math.floor((beside * LETTER) / (LETTER * Math.max(...keys.map(longest)) + 50)));
    const legend = layout.showlegend ? LINE * (Math.ceil(keys.length / inARow) * Math.max(...keys.map(lines)) - 1) : 0;
    const xaxis = { ...axis, ...layout.xaxis, title: { ...axis.title, ...(layout.xaxis.title || {}) } };
    const yaxis = { ...axis, ticks: "outside", ticklen: 6, tickcolor: "#fff", ...layout.yaxis, tickvals: rows, ticktext: names };
    const shown = { ...base, ...layout, height: layout.height + taller + legend, xaxis, yaxis };
    const hover = (t) => `${t.hovertemplate}<br>${folded(t.name, HOVER)}<extra></extra>`;
    const drawn = Plotly.react(place, traces.map((t, k) => ({ ...t, name: keys[k], hovertemplate: hover(t) })), shown, config);
    drawn.then(() => { place.dataset.wide = wide; });
  }
  const LETTER = 7.4, LINE = 19, HOVER = 32;
  const lines = (text) => text.split("<br>").length;
  const longest = (text) => Math.max(...text.split("<br>").map((line) => raw(line).length));
  all("[data-plot]").forEach(plot);
  // Plotly reads a few tags in its texts; names are to be seen as they are.
  function plain(text) { return String(text).replace(/&/g, "&amp;").replace(/</g, "&lt;").replace(/>/g, "&gt;"); }
  function raw(text) { const reader = document.createElement("textarea"); reader.innerHTML = text; return reader.value; }
  // A text of Plotly's in lines of so many letters, broken after what is no letter where that can be.
  function folded(text, letters) {
    return text.split("<br>").map((part) => {
      const folds = [""];
      for (let word of raw(part).split(/(?<=[^\p{L}\p{N}])/u)) {
        if (folds.at(-1) && (folds.at(-1) + word).trimEnd().length > letters) folds.push("");
        for (; word.length > letters; word = word.slice(letters)) folds.splice(-1, 1, folds.at(-1) + word.slice(0, letters), "");
        folds[folds.length - 1] += word;
      }
      return folds.filter((line) => line.trim()).map((line) => plain(line.trimEnd())).join("<br>");
    }).join("<br>");
  }

  // The part that is read is marked in the navigation
  const links = new Map(all("nav a").map((a) => [a.hash.slice(1), a]));
  const watch = new IntersectionObserver((seen) => {
    for (const { target, isIntersecting } of seen) {
      const link = links.get(target.id);
      if (isIntersecting) { all("nav a").forEach((a) => a.removeAttribute("aria-current")); link.setAttribute("aria-current", "true"); }
    }
  }, { rootMargin: "-30% 0px -65% 0px" });
  all("main section").forEach((section) => watch.observe(section));

  // Gallery
  const cards = all(".cards > li"), selects = all(".filters select[data-field]");
  function filter() {
    let count = 0;
    for (const card of cards) {
      card.hidden = selects.some((s) => s.value && card.dataset[s.dataset.field] !== s.value);
      count += !card.hidden;
    }
    if (one("#shown")) one("#shown").textContent = count === cards.length ? "" : `${count} of ${cards.length} shown`;
  }
  selects.forEach((s) => s.addEventListener("change", filter));

  // Viewer
  const viewer = one("#viewer"), canvas = one("#above"), scrub = one("#scrub"), play = one("#play");
  const COLOURS = { ...data.ground, road: "#8b8f95", walk: "#efece4", crossing: "#f4edb4", verge: "#a5cda0", obstacle: "#7d5a34", barrier: "#cf2e2e",
    event: "#e06c00", injected: "#e06c00", crowd: "#7d6bb3", resident: "#008c6e", vehicle: "#3c5082" };
  let scene = null, entry = -1, sample = 0, timer = 0, view = null;

  function open(number) {
    pause();
    entry = number;
    scene = read(`scene-${number}`);
    const card = one(`[data-entry="${number}"]`);
    one("#viewer-reason").textContent = one("b", card).textContent;
    one("#viewer-facts").textContent = all("small", card).map((s) => s.innerText.replace(/\n/g, " · ")).join(" · ");
    scrub.max = String(scene.robot.length / 6 - 1);
    view = framed();
    if (!viewer.open) { viewer.showModal(); play.focus(); }
    show(0);
  }
  function close() { pause(); viewer.close(); }
  function pause() { clearInterval(timer); timer = 0; play.textContent = "Play"; }
  function toggle() {
    if (timer) { pause(); return; }
    if (sample >= Number(scrub.max)) show(0);
    play.textContent = "Pause";
    timer = setInterval(() => { if (sample >= Number(scrub.max)) pause(); else show(sample + 1); }, 1000 * scene.step_s);
  }
  function next(by) {
    const shown = cards.filter((c) => !c.hidden).map((c) => one("[data-entry]", c)).filter(Boolean).map((b) => Number(b.dataset.entry));
    const at = shown.indexOf(entry);
    if (shown.length) open(shown[(at + by + shown.length) % shown.length]);
  }
  function show(number) {
    sample = Math.max(0, Math.min(number, Number(scrub.max)));
    scrub.value = String(sample);
    const before = (Number(scrub.max) - sample) * scene.step_s;
    one("#clock").textContent = before < 1e-6 ? "the failure" : `${before.toFixed(1)} s before`;
    scrub.setAttribute("aria-valuetext", one("#clock").textContent);
    const { at, robot, follow } = scene.pictures;
    let k = 0;
    while (k + 1 < at.length && at[k + 1] <= sample) k += 1;
    for (const [id, list] of [["#by-robot", robot], ["#from-behind", follow]]) {
      const picture = one(id);
      picture.closest("figure").hidden = !list.length;
      if (list.length && picture.src !== list[k]) picture.src = list[k];
    }
    drawWay(k);
    draw();
  }
  // The waypoints that are followed at this moment: x, y, x, y ..., the first where the robot was asked; or nothing
  function planned() {
    let plan = [];
    for (const [from, points] of scene.plans) if (from <= sample) plan = points;
    return plan;
  }
  // In the robot's picture, which is as wide as it can be, or covers its place
  function drawWay(k) {
    const { ways, size: [wide, high] } = scene.pictures, way = one("#way");
    one("#key-way").textContent = planned().length ? "planned waypoints, the full one is followed" : "what was commanded, 1.5 s on";
    way.innerHTML = "";
    if (!ways.length || scene.pictures.at[k] > sample) return;
    way.setAttribute("viewBox", `0 0 ${10 * wide} ${10 * high}`);
    way.setAttribute("preserveAspectRatio", getComputedStyle(one("#by-robot")).objectFit === "cover" ? "xMidYMid slice" : "xMidYMid meet");
    const add = (name, attributes) => {
      const part = document.createElementNS("http://www.w3.org/2000/svg", name);
      for (const [key, value] of Object.entries(attributes)) part.setAttribute(key, value);
      way.append(part);
    };
    const { lines, points, follows } = ways[k], d = lines.map((points) => `M${points.join(" ")}`).join("");
    if (d) for (const edge of ["edge", ""]) add("path", { d, class: edge });
    for (let i = 0; 2 * i < points.length; i += 1) {
      add("circle", { cx: points[2 * i], cy: points[2 * i + 1], r: wide * (i === follows ? 0.2 : 0.12), class: i === follows ? "followed" : "" });
    }
  }

  // From above: the robot's heading at the end is up, so that left is left
  function framed() {
    const n = scene.robot.length / 6, end = (n - 1) * 6;
    const turn = Math.PI / 2 - scene.robot[end + 2] / 1000;
    const cos = Math.cos(turn), sin = Math.sin(turn);
    let x0 = Infinity, x1 = -Infinity, y0 = Infinity, y1 = -Infinity;
    const take = (x, y) => { const u = x * cos - y * sin, v = x * sin + y * cos;
      x0 = Math.min(x0, u); x1 = Math.max(x1, u); y0 = Math.min(y0, v); y1 = Math.max(y1, v); };
    for (let i = 0; i < n; i += 1) take(scene.robot[6 * i], scene.robot[6 * i + 1]);
    const met = scene.tracks[scene.hit];
    if (met) for (let i = Math.max(0, met.at.length - 3 * 50); i < met.at.length; i += 3) take(met.at[i], met.at[i + 1]);
    const span = Math.min(Math.max(x1 - x0, y1 - y0, 900) + 500, 2600);
    let midX = (x0 + x1) / 2, midY = (y0 + y1) / 2;
    const ex = scene.robot[end] * cos - scene.robot[end + 1] * sin, ey = scene.robot[end] * sin + scene.robot[end + 1] * cos;
    midX = Math.max(ex - span * 0.35, Math.min(ex + span * 0.35, midX));
    midY = Math.max(ey - span * 0.3, Math.min(ey + span * 0.35, midY));
    return { cos, sin, turn, scale: canvas.width / span, midX, midY };
  }
  const at = (x, y) => {
    const { cos, sin, scale, midX, midY } = view;
    return [canvas.width / 2 + (x * cos - y * sin - midX) * scale, canvas.height / 2 - (x * sin + y * cos - midY) * scale];
  };
  function path(c, points) {
    for (let i = 0; i < points.length; i += 2) { const [x, y] = at(points[i], points[i + 1]); if (i) c.lineTo(x, y); else c.moveTo(x, y); }
  }
  function line(c, points, colour, width, dash = []) {
    c.beginPath(); path(c, points); c.strokeStyle = colour; c.lineWidth = width * view.scale; c.setLineDash(dash.map((d) => d * view.scale));
    c.lineJoin = c.lineCap = "round"; c.stroke(); c.setLineDash([]);
  }
  function box(c, x, y, heading, length, width, colour) {
    const a = heading, l = length / 2, w = width / 2, points = [];
    for (const [u, v] of [[l, w], [l, -w], [-l, -w], [-l, w]]) points.push(x + u * Math.cos(a) - v * Math.sin(a), y + u * Math.sin(a) + v * Math.cos(a));
    c.beginPath(); path(c, points); c.closePath(); c.fillStyle = colour; c.fill();
  }
  function person(c, x, y, heading, colour) {
    const [px, py] = at(x, y), r = 30 * view.scale, a = -(heading + view.turn);
    c.beginPath(); c.arc(px, py, r, 0, 7); c.fillStyle = colour; c.fill();
    c.lineWidth = 1.5; c.strokeStyle = "#fff"; c.stroke();
    c.beginPath(); c.moveTo(px + 1.9 * r * Math.cos(a), py + 1.9 * r * Math.sin(a));
    c.lineTo(px + 0.9 * r * Math.cos(a + 0.75), py + 0.9 * r * Math.sin(a + 0.75));
    c.lineTo(px + 0.9 * r * Math.cos(a - 0.75), py + 0.9 * r * Math.sin(a - 0.75)); c.closePath(); c.fillStyle = colour; c.fill();
  }
  function draw() {
    const c = canvas.getContext("2d");
    c.fillStyle = COLOURS.lawn; c.fillRect(0, 0, canvas.width, canvas.height);
    for (const [kind, rings] of scene.ground) {
      c.beginPath();
      for (const ring of rings) { path(c, ring); c.closePath(); }
      c.fillStyle = c.strokeStyle = COLOURS[kind] || "#ccc"; c.lineWidth = 1; c.fill("evenodd"); c.stroke();
    }
    for (const signal of scene.signals) {
      const state = signal.states[sample];
      if (state !== "-") line(c, signal.line, state === "g" ? "#1f9d55" : "#d01818", 25);
    }
    line(c, scene.route, "rgb(60 120 220 / .55)", 14);
    const [gx, gy] = at(...scene.goal);
    c.beginPath(); c.arc(gx, gy, 100 * view.scale, 0, 7); c.strokeStyle = "#3c78dc"; c.lineWidth = 3; c.stroke();
    const track = [];
    for (let i = 0; i <= sample; i += 1) track.push(scene.robot[6 * i], scene.robot[6 * i + 1]);
    line(c, track, "rgb(20 24 29 / .55)", 7);
    scene.tracks.forEach((who, number) => {
      const i = sample - who.first;
      if (i < 0 || 3 * i >= who.at.length) return;
      const [x, y, h] = [who.at[3 * i], who.at[3 * i + 1], who.at[3 * i + 2] / 1000];
      if (number === scene.hit) {
        const before = [];
        for (let k = 0; k <= i; k += 1) before.push(who.at[3 * k], who.at[3 * k + 1]);
        line(c, before, "rgb(208 24 24 / .45)", 6, [18, 18]);
      }
      if (who.kind === "vehicle") box(c, x, y, h, who.size[0], who.size[1], COLOURS.vehicle);
      else person(c, x, y, h, COLOURS[who.kind] || COLOURS.crowd);
      if (number === scene.hit) {
        const [px, py] = at(x, y);
        c.beginPath(); c.arc(px, py, Math.max(who.size[0], 100) * 0.62 * view.scale, 0, 7); c.strokeStyle = "#d01818"; c.lineWidth = 3; c.stroke();
      }
      let doing = "";
      for (const [from, word] of who.doing) if (from <= sample) doing = word;
      if (doing && doing !== "walk" && doing !== "stand") { const [px, py] = at(x, y); words(c, doing, px, py - 46 * view.scale - 6, "center"); }
    });
    const [x, y, h, , v, w] = scene.robot.slice(6 * sample, 6 * sample + 6);
    const plan = planned(), ahead = [...plan];
    let ax = x, ay = y, ah = h / 1000;
    for (let k = 0; k <= 15 && !plan.length; k += 1) { ahead.push(ax, ay); ax += 0.1 * v * Math.cos(ah); ay += 0.1 * v * Math.sin(ah); ah += 0.1 * w / 1000; }
    line(c, ahead, "#0fa3b1", 8);
    box(c, x, y, h / 1000, scene.size[0] + 24, scene.size[1] + 24, "#fff");
    box(c, x, y, h / 1000, scene.size[0], scene.size[1], "#14181d");
    const nose = scene.size[0] * 0.32;
    box(c, x + nose * Math.cos(h / 1000), y + nose * Math.sin(h / 1000), h / 1000, scene.size[0] * 0.18, scene.size[1] * 0.7, "#5ac8ff");
    for (let k = 1; 2 * k < plan.length; k += 1) {
      const [px, py] = at(plan[2 * k], plan[2 * k + 1]), full = k === scene.follows;
      c.beginPath(); c.arc(px, py, (full ? 14 : 9) * view.scale, 0, 7); c.lineWidth = 2;
      c.fillStyle = full ? "#0fa3b1" : "#fff"; c.strokeStyle = full ? "#fff" : "#0fa3b1"; c.fill(); c.stroke();
    }
    const metres = view.scale * canvas.width > 0 && canvas.width / view.scale > 1600 ? 5 : 2, long = metres * 100 * view.scale;
    c.fillStyle = "#14181d"; c.fillRect(20, canvas.height - 24, long, 4);
    words(c, `${metres} m`, 20, canvas.height - 34, "left");
    words(c, `${(Math.round(scene.robot[6 * sample + 3] / 10) / 10 || 0).toFixed(1)} m/s`, canvas.width - 20, canvas.height - 22, "right");
  }
  function words(c, text, x, y, align) {
    c.font = `600 ${Math.round(canvas.width / 42)}px ${getComputedStyle(document.body).fontFamily}`;
    c.textAlign = align; c.lineWidth = 4; c.lineJoin = "round"; c.strokeStyle = "rgb(255 255 255 / .9)"; c.strokeText(text, x, y);
    c.fillStyle = "#14181d"; c.fillText(text, x, y);
  }
  all("[data-entry]").forEach((b) => b.addEventListener("click", () => open(Number(b.dataset.entry))));
  scrub.addEventListener("input", () => { pause(); show(Number(scrub.value)); });
  play.addEventListener("click", toggle);
  one("[data-do=close]").addEventListener("click", close);
  one("[data-do=back]").addEventListener("click", () => next(-1));
  one("[data-do=on]").addEventListener("click", () => next(1));
  viewer.addEventListener("click", (e) => { if (e.target === viewer) close(); });
  viewer.addEventListener("close", pause);
  viewer.addEventListener("keydown", (e) => {
    const by = { ArrowRight: 1, ArrowLeft: -1 }[e.key];
    if (by && e.shiftKey) next(by);
    else if (by) { pause(); show(sample + by); }
    else if (e.key === "Home") { pause(); show(0); }
    else if (e.key === "End") { pause(); show(Number(scrub.max)); }
    else if (e.key === " " && !e.target.matches("button:not(#play)")) toggle();
    else return;
    e.preventDefault();
  });

  // Maps
  const chooser = one("#place");
  function map() {
    const picture = data.maps.pictures[Number(chooser.value)], spots = data.maps.spots[picture.place] || [];
    one("#map-name").textContent = picture.place;
    const [x0, y0, x1, y1] = picture.bounds, causes = Object.keys(data.causes).filter((cause) => spots.some((s) => s.cause === cause));
    const traces = causes.map((cause) => {
      const of = spots.filter((s) => s.cause === cause);
      return { type: "scatter", mode: "markers", name: cause, x: of.map((s) => s.x_m), y: of.map((s) => s.y_m),
        text: of.map((s) => folded(plain(s.words), HOVER)), customdata: of.map((s) => s.entry), hovertemplate: "%{text}<extra></extra>",
        marker: { opacity: 1, size: of.map((s) => (s.entry < 0 ? 9 : 15)), color: data.causes[cause], line: { color: "#fff", width: 1.5 } } };
    });
    const width = one("#map").clientWidth, height = Math.max(160, Math.min(width * (y1 - y0) / (x1 - x0), 760)) + 40;
    const still = { visible: false, range: [x0, x1] };
    const legend = { ...base.legend, itemsizing: "constant" };
    const layout = { ...base, legend, height, margin: { l: 0, r: 0, t: 34, b: 0 }, dragmode: "pan", showlegend: true, xaxis: still,
      yaxis: { visible: false, range: [y0, y1], scaleanchor: "x" },
      images: [{ source: picture.image, xref: "x", yref: "y", x: x0, y: y1, sizex: x1 - x0, sizey: y1 - y0, sizing: "stretch", layer: "below" }] };
    return Plotly.react(one("#map"), traces, layout, { responsive: true, displayModeBar: width > 600, displaylogo: false,
      modeBarButtons: [["pan2d", "zoom2d", "zoomIn2d", "zoomOut2d", "resetScale2d"]] });
  }
  if (chooser) {
    map().then((drawing) => drawing.on("plotly_click", ({ points }) => { if (points[0].customdata >= 0) open(points[0].customdata); }));
    chooser.addEventListener("change", map);
  }
  let width = innerWidth, later = 0;
  addEventListener("resize", () => {
    if (innerWidth === width) return;
    width = innerWidth;
    clearTimeout(later);
    later = setTimeout(() => { all("[data-plot]").forEach(plot); if (chooser) map(); }, 150);
  });
  addEventListener("beforeprint", () => all("[data-plot]").forEach((p) => Plotly.Plots.resize(p)));
  document.documentElement.dataset.ready = "true";
})();
