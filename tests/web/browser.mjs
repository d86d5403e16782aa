// Starts headless Chromium, opens a page of the playground, and collects what its console reports.
import { execSync } from "node:child_process";
import { chromium } from "playwright-core";

const NAMES = ["chromium-headless-shell", "chromium", "google-chrome"];

export function executable() {
  for (const name of NAMES) {
    try {
      return execSync(`command -v ${name}`, { shell: "/bin/sh" }).toString().trim();
    } catch {
      // the next one
    }
  }
  return null;
}

export async function launch() {
  return chromium.launch({ executablePath: executable(), args: ["--no-sandbox", "--disable-gpu"] });
}

/** `before` is run in the page before its own scripts. */
export async function openPage(browser, address, { before, ...options } = {}) {
  const page = await browser.newPage({ viewport: { width: 1440, height: 900 }, ...options });
  if (before) await page.addInitScript(before);
  const problems = [];
  page.on("console", (message) => {
    if (["error", "warning"].includes(message.type())) problems.push(message.text());
  });
  page.on("pageerror", (error) => problems.push(String(error)));
  await page.goto(address);
  await page.waitForFunction(() => globalThis.powderdsl?.firstWorld);
  return { page, problems };
}
