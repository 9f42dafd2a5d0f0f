// What a browser shows of the site's page: its text, and a picture where one is asked for.
//
// usage: page.mjs URL TEXT [PICTURE]     waits until the page says TEXT
//
// Needs playwright-core (npm install playwright-core@1.64.1) and Debian's chromium; ends with 77 where
// one of them is not there.
import { existsSync } from "node:fs";
import { createRequire } from "node:module";
import { resolve } from "node:path";

const [url, text, picture] = process.argv.slice(2);
const modules = createRequire(`${resolve(process.env.CROSSFIX_NODE ?? ".")}/node_modules/`);
let playwright;
try {
  playwright = modules("playwright-core");
} catch {
  console.log("SKIPPED: needs playwright-core (npm install playwright-core, CROSSFIX_NODE is where)");
  process.exit(77);
}
const executablePath = "/usr/bin/chromium";
if (!existsSync(executablePath)) {
  console.log("SKIPPED: needs a browser (apt-get install chromium)");
  process.exit(77);
}
const browser = await playwright.chromium.launch({
  executablePath,
  args: ["--no-sandbox", "--disable-quic", "--no-proxy-server", "--disable-background-networking"],
});
const page = await browser.newPage({ viewport: { width: 1400, height: 900 } });
const errors = [];
page.on("pageerror", (error) => errors.push(String(error)));
page.on("console", (message) => message.type() === "error" && errors.push(message.text()));
await page.goto(url);
await page.getByText(text).first().waitFor({ timeout: 20000 });
await page.waitForTimeout(1500);
if (picture) await page.screenshot({ path: picture });
// How much of the plan is drawn: pixels that are not empty.
const drawn = await page.evaluate(() => {
  const canvas = document.querySelector("canvas");
  const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
  return data.filter((value, index) => index % 4 === 3 && value > 0).length;
});
console.log(JSON.stringify({ text: await page.innerText("body"), drawn, errors }));
await browser.close();
