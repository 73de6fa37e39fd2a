"use strict";
/* Draws each overlay: the picture, left of the divider the cloud before, right of it the cloud after. */
for (const root of document.querySelectorAll(".overlay")) {
  const data = JSON.parse(root.querySelector("script").textContent);
  const image = root.querySelector("img"), canvas = root.querySelector("canvas"), pen = canvas.getContext("2d");
  const bytes = text => Uint8Array.from(atob(text), c => c.charCodeAt(0));
  const words = text => { const b = bytes(text); return new Uint16Array(b.buffer); };
  const signed = text => { const b = bytes(text); return new Int8Array(b.buffer); };
  const depths = words(data.depth), classes = bytes(data.class), count = depths.length;
  const sides = [
    { places: data.before === null ? null : words(data.before), residuals: signed(data.residualBefore), name: "before" },
    { places: words(data.after), residuals: signed(data.residual), name: "after" },
  ];
  const hidden = 65535, none = -128;
  const hues = { 0: "#9aa0a6", 1: "#37d67a", 2: "#a05a82", 3: "#6eaabe", 4: "#5f9e3c", 5: "#f2c14e", 6: "#ff6b6b",
    7: "#d66bd6", 8: "#7db7ff", 9: "#8fae6a", 10: "#b39b7d", 11: "#f2c14e", 255: "#777777" };
  const depthColour = cm => {
    const t = Math.min(1, Math.max(0, Math.log(cm / 300) / Math.log(6000 / 300)));
    return `hsl(${Math.round(20 + 230 * t)} 95% 58%)`;
  };
  const residualColour = steps => {
    const px = Math.abs(steps) / 8;
    return px < 1.5 ? "#39e06f" : px < 4 ? "#ffc233" : "#ff4b4b";
  };
  const hasResiduals = sides[1].residuals.some(r => r !== none);
  let mode = "depth", divider = sides[0].places === null ? 0 : 0.5, contours = true;

  function drawSide(side, left, right) {
    if (side.places === null || right <= left) return;
    pen.save();
    pen.beginPath(); pen.rect(left, 0, right - left, canvas.height); pen.clip();
    const zoom = Math.max(1, canvas.width / Math.max(1, canvas.clientWidth));
    for (let i = 0; i < count; i++) {
      const x = side.places[i], y = side.places[count + i], residual = side.residuals[i];
      if (x === hidden || y === hidden) continue;
      const boundary = residual !== none;
      if (mode === "residual" ? !boundary : boundary) continue;
      const u = x / 65534 * canvas.width, v = y / 65534 * canvas.height;
      const size = (mode === "residual" ? 5.2 : 1.7) * Math.sqrt(zoom);
      pen.fillStyle = mode === "depth" ? depthColour(depths[i])
        : mode === "class" ? (hues[classes[i]] || "#9aa0a6") : residualColour(residual);
      pen.fillRect(u - size / 2, v - size / 2, size, size);
    }
    pen.restore();
  }
  function draw() {
    const split = divider * canvas.width;
    pen.globalAlpha = 1;
    pen.drawImage(image, 0, 0, canvas.width, canvas.height);
    pen.fillStyle = "rgba(0,0,0,.35)"; pen.fillRect(0, 0, canvas.width, canvas.height);
    if (contours) {
      pen.strokeStyle = "#ffe600"; pen.lineWidth = Math.max(1, canvas.width / Math.max(1, canvas.clientWidth));
      for (const line of data.contours) {
        pen.beginPath();
        for (let k = 0; k < line.length; k += 2) pen.lineTo(line[k], line[k + 1]);
        pen.closePath(); pen.stroke();
      }
    }
    drawSide(sides[0], 0, split);
    drawSide(sides[1], split, canvas.width);
    const zoom = Math.max(1, canvas.width / Math.max(1, canvas.clientWidth)), font = 15 * zoom;
    if (sides[0].places !== null) {
      pen.fillStyle = "#fff"; pen.fillRect(split - zoom, 0, 2 * zoom, canvas.height);
      pen.font = `600 ${font}px system-ui, sans-serif`; pen.textBaseline = "top";
      const tag = (words, left) => {
        const width = pen.measureText(words).width + font;
        pen.fillStyle = "rgba(0,0,0,.65)"; pen.fillRect(left ? 0 : canvas.width - width, 0, width, 1.6 * font);
        pen.fillStyle = "#fff"; pen.fillText(words, left ? font / 2 : canvas.width - width + font / 2, font * 0.3);
      };
      if (divider > 0.02) tag("before", true);
      if (divider < 0.98) tag("after", false);
    }
    drawKey();
  }

  const bar = document.createElement("div"), key = document.createElement("div");
  bar.className = "bar"; key.className = "key";
  const slider = document.createElement("input");
  if (sides[0].places !== null) {
    Object.assign(slider, { type: "range", min: 0, max: 100, value: 50 });
    slider.setAttribute("aria-label", "divider between before (left) and after (right)");
    slider.addEventListener("input", () => { divider = slider.value / 100; draw(); });
    const drag = event => {
      if (event.buttons !== 1) return;
      divider = Math.min(1, Math.max(0, event.offsetX / canvas.clientWidth));
      slider.value = 100 * divider; draw();
    };
    canvas.addEventListener("pointerdown", drag);
    canvas.addEventListener("pointermove", drag);
    root.classList.add("divided");
    bar.append("divider", slider);
  }
  const modes = document.createElement("fieldset"), legend = document.createElement("legend");
  legend.textContent = "colour by"; modes.append(legend);
  const group = `mode-${[...document.querySelectorAll(".overlay")].indexOf(root)}`;
  const hasClasses = Object.keys(data.classes).length > 1;
  const names = ["depth", ...(hasClasses ? ["class"] : []), ...(hasResiduals ? ["residual"] : [])];
  for (const name of names) {
    const label = document.createElement("label"), radio = document.createElement("input");
    Object.assign(radio, { type: "radio", name: group, value: name, checked: name === mode });
    radio.addEventListener("change", () => { mode = name; draw(); });
    label.append(radio, name); modes.append(label);
  }
  const label = document.createElement("label"), box = document.createElement("input");
  Object.assign(box, { type: "checkbox", checked: true });
  box.addEventListener("change", () => { contours = box.checked; draw(); });
  label.append(box, "contours of the labels");
  bar.append(...(names.length > 1 ? [modes] : []), ...(data.contours.length ? [label] : []));
  function drawKey() {
    const entries = mode === "class" ? Object.entries(data.classes).map(([c, name]) => [hues[c] || "#9aa0a6", name])
      : mode === "residual" ? [["#39e06f", `within 1.5 px of the ${data.edge}`], ["#ffc233", "1.5 to 4 px"], ["#ff4b4b", "farther"]]
      : [["linear-gradient(90deg," + [300, 800, 2000, 6000].map(depthColour).join(",") + ")", "3 m to 60 m deep"]];
    key.replaceChildren(...entries.map(([colour, name]) => {
      const entry = document.createElement("span"), swatch = document.createElement("i");
      swatch.className = mode === "depth" ? "swatch ramp" : "swatch"; swatch.style.background = colour;
      entry.append(swatch, name); return entry;
    }));
  }
  root.append(bar, key);
  image.decode().then(draw);
  addEventListener("resize", draw);
}
