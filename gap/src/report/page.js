// Shows the readings under the pointer below each plot.
for (const svg of document.querySelectorAll("svg.wide")) {
  const readout = svg.parentNode.querySelector(".readout");
  for (const probe of svg.querySelectorAll(".probe")) {
    const cursor = probe.previousElementSibling;
    const points = probe.dataset.points.split(";").map((point) => point.split(","));
    probe.addEventListener("pointermove", (event) => {
      const x = new DOMPoint(event.clientX, event.clientY).matrixTransform(svg.getScreenCTM().inverse()).x;
      const off = (point) => Math.abs(point[0] - x);
      const [at, time, measured, before, r1, after, r2] = points.reduce((a, b) => (off(a) > off(b) ? b : a));
      cursor.setAttribute("x1", at);
      cursor.setAttribute("x2", at);
      cursor.style.visibility = "visible";
      const known = (name, value, r) => (value === "–" ? "" : `, ${name} ${value} (residual ${r})`);
      readout.textContent = `${time} s: measured ${measured}${known("before", before, r1)}${known("with the effect", after, r2)}`;
    });
    probe.addEventListener("pointerleave", () => {
      cursor.style.visibility = "hidden";
      readout.textContent = "";
    });
  }
}
