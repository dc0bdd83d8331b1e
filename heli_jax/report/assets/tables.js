// Tables that copy as CSV and as LaTeX; and all that is folded opens for printing.
"use strict";
(() => {
  const UP = "⁻⁰¹²³⁴⁵⁶⁷⁸⁹";
  const plain = s => [...s].map(c => UP.includes(c) ? "-0123456789"[UP.indexOf(c)] : c).join("");
  const rows = table => [...table.rows].map(r => [...r.cells].map(c => c.textContent.trim()));

  // What is printed as −1.2·10⁻³ is a number to other programs as -1.2e-3 alone.
  const ascii = text => text
    .replace(/·10([⁻⁰¹²³⁴⁵⁶⁷⁸⁹]+)/g, (_, power) => "e" + plain(power)).replace(/−(?=[\d.])/g, "-");

  // A spreadsheet counts with cells that are numbers and nothing else: what a cell has beside its
  // number gets a column of its own, by the names behind the column's.
  const NUMBER = "([+-]?(?:\\d[\\d.]*(?:e-?\\d+)?|∞))", PLAIN = new RegExp(`^${NUMBER}$`);
  const FORMS = [["N"], ["N %", " [%]"], ["N to N", ", from", ", to"], ["N ± N", "", ", sd"],
    ["N \\(N to N\\)(?:, (.*))?", "", ", from", ", to", ", also"], ["N ([^\\d(]+)", "", ", unit"]]
    .map(([form, ...names]) => ({ form: new RegExp(`^${form.replaceAll("N", NUMBER)}$`), names }));
  // Without a second number a plain one may stand among them: it has no sd, or no unit.
  const alone = names => names.length > 1 && names[0] === "";

  function parts(head, cells) {
    const numbers = cells.filter(c => /\d/.test(c));
    const is = ({ form, names }) => numbers.every(c => form.test(c) || (alone(names) && PLAIN.test(c)));
    const found = numbers.length ? FORMS.find(is) : undefined;
    if (!found || !found.names.length) return [[head, ...cells]];
    return found.names.map((name, i) => [head + name,
      ...cells.map(c => found.form.exec(c)?.[i + 1] ?? (i ? "" : c))]);
  }

  function csv(table) {
    let all = rows(table).map(r => r.map(ascii).map(c => c === "–" ? "" : c));
    if (table.tHead) {
      const [first, ...others] = all[0].map((_, k) => all.map(r => r[k]));
      const columns = [first, ...others.flatMap(([head, ...cells]) => parts(head, cells))];
      all = all.map((_, i) => columns.map(column => column[i]));
    }
    return all.map(r => r.map(quoted).join(",")).join("\n") + "\n";
  }
  const quoted = text => /[",\n]/.test(text) ? `"${text.replaceAll('"', '""')}"` : text;

  const LATEX = { "\\": "\\textbackslash{}", "{": "\\{", "}": "\\}", "_": "\\_", "%": "\\%", "&": "\\&",
    "#": "\\#", "$": "\\$", "^": "\\^{}", "~": "\\~{}", "–": "--", "±": "$\\pm$", "−": "$-$", "∞": "$\\infty$",
    "ω": "$\\omega$", "χ": "$\\chi$", "<": "$<$", ">": "$>$", "✓": "", "✗": "", "₁": "$_1$", "₈": "$_8$", "₀": "$_0$" };
  const latex = text => text
    .replace(/[\\{}_%&#$^~–±−∞ωχ<>✓✗₁₈₀]/g, c => LATEX[c])
    .replace(/·10([⁻⁰¹²³⁴⁵⁶⁷⁸⁹]+)/g, (_, power) => `$\\cdot 10^{${plain(power)}}$`)
    .replace(/[⁻⁰¹²³⁴⁵⁶⁷⁸⁹]+/g, power => `$^{${plain(power)}}$`)
    .replaceAll("·", "$\\cdot$").trim();

  function tex(table) {
    const all = rows(table), head = table.tHead ? all.shift() : null;
    const line = row => "  " + row.map(latex).join(" & ") + " \\\\";
    const columns = "l" + "r".repeat(Math.max(0, (all[0] ?? head).length - 1));
    return [`\\begin{tabular}{${columns}}`, "  \\toprule", ...(head ? [line(head), "  \\midrule"] : []),
      ...all.map(line), "  \\bottomrule", "\\end{tabular}", ""].join("\n");
  }

  async function copy(text, place) {
    // A page that was opened as a file has no navigator.clipboard in some browsers.
    try {
      await navigator.clipboard.writeText(text);
      return true;
    } catch {
      const area = document.createElement("textarea");
      area.value = text;
      area.setAttribute("aria-label", "to be copied");
      place.append(area);
      area.select();
      // Where this fails too the text stays there, selected.
      const done = document.execCommand("copy");
      if (done) area.remove();
      return done;
    }
  }

  for (const table of document.querySelectorAll(".wide > table")) {
    const bar = document.createElement("div");
    bar.className = "copy";
    const said = document.createElement("span");
    said.setAttribute("role", "status");
    for (const [name, made] of [["CSV", csv], ["LaTeX", tex]]) {
      const button = document.createElement("button");
      button.type = "button";
      button.textContent = name;
      button.setAttribute("aria-label", `Copy the table as ${name}`);
      button.addEventListener("click", async () => {
        bar.querySelector("textarea")?.remove();
        const done = await copy(made(table), bar);
        said.textContent = done ? `${name} copied` : "select and copy:";
        if (done) button.focus();
      });
      bar.append(button);
    }
    bar.append(said);
    table.parentElement.after(bar);
  }
  // On a telephone a table or an image may be wider than the page: it is said where more of it is.
  const wides = document.querySelectorAll(".wide, figure");
  const look = e => e.classList.toggle("more", e.scrollWidth - e.clientWidth - e.scrollLeft > 2);
  for (const e of wides) e.addEventListener("scroll", () => look(e), { passive: true });
  const sizes = new ResizeObserver(entries => entries.forEach(entry => look(entry.target)));
  for (const e of wides) sizes.observe(e);
  window.heliTables = { csv, tex };

  let closed = [];
  addEventListener("beforeprint", () => {
    for (const d of document.querySelectorAll("details:not([open])")) {
      d.open = true;
      closed.push(d);
    }
  });
  addEventListener("afterprint", () => {
    for (const d of closed) d.open = false;
    closed = [];
  });
})();
