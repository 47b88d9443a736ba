// Runs the script of a page without a browser and prints the legends of its plots, a line each.
// node run_page.js PAGE.html STATE [EXPRESSION]; the value of an expression is printed last
const page = require("fs").readFileSync(process.argv[2], "utf8");
const [data, script] = [...page.matchAll(/<script[^>]*>([^]*?)<\/script>/g)].map((found) => found[1]);

class Element { // what the script uses of the DOM; without WebGL it draws only plots
  constructor() { Object.assign(this, { children: [], style: {}, textContent: "", value: "0", clientWidth: 800, clientHeight: 100 }); }
  append(...children) { this.children.push(...children); }
  addEventListener() {}
  getContext(kind) { return kind === "webgl2" ? null : new Proxy({}, { get: () => () => {} }); }
  get text() { return this.textContent + this.children.map((child) => child.text ?? child).join(""); }
}
const elements = {};
const byName = (id) => elements[id] ??= new Element();
byName("data").textContent = data;
globalThis.document = { getElementById: byName, createElement: () => new Element() };
globalThis.getComputedStyle = () => ({ getPropertyValue: () => "#123456" });
globalThis.window = {};
globalThis.location = { hash: `#${process.argv[3]}` };
(0, eval)(script + (process.argv[4] ? `;globalThis.found = ${process.argv[4]}` : ""));
for (const child of byName("plots").children) console.log(child.text);
if (process.argv[4]) console.log(JSON.stringify(globalThis.found));
