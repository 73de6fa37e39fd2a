"use strict";
const table = document.getElementById("drives-table");
if (table) {
  const words = document.getElementById("words");
  const chosen = document.getElementById("status");
  const count = document.getElementById("shown");
  const rows = Array.from(table.tBodies[0].rows);
  const show = () => {
    let shown = 0;
    const text = words.value.toLowerCase();
    for (const row of rows) {
      const fits = (!chosen.value || row.dataset.status === chosen.value)
        && (!text || row.textContent.toLowerCase().includes(text));
      row.hidden = !fits;
      shown += fits;
    }
    count.textContent = `${shown} of ${rows.length} rows`;
  };
  words.addEventListener("input", show);
  chosen.addEventListener("change", show);
  show();
  Array.from(table.tHead.rows[0].cells).forEach((head, column) => {
    let sense = 1;
    head.classList.add("sortable");
    head.addEventListener("click", () => {
      const of = (row) => row.cells[column].dataset.value ?? row.cells[column].textContent;
      const number = (text) => (text === "" ? Infinity : Number(text));
      rows.sort((a, b) => {
        const x = of(a), y = of(b);
        const numeric = !Number.isNaN(number(x)) && !Number.isNaN(number(y));
        return sense * (numeric ? number(x) - number(y) || 0 : x.localeCompare(y));
      });
      sense = -sense;
      rows.forEach((row) => table.tBodies[0].append(row));
    });
  });
}
