// The connection to the estimator: a WebSocket for news, requests for commands. Addresses are relative, for proxies.

import { keep, recall } from "./keep.js";

const LOST_S = 3; // without a message, after which the connection counts as lost
const RETRY_MS = 1000;

export class Link {
  constructor(handlers) {
    this.handlers = handlers;
    this.token = readToken();
    this.heard = performance.now();
    this.connect();
    setInterval(() => this.watch(), 1000);
  }

  connect() {
    const url = new URL("live", location.href);
    url.protocol = url.protocol.replace("http", "ws");
    url.hash = "";
    const socket = new WebSocket(url, ["rovgraph", ...(this.token ? [`token.${this.token}`] : [])]);
    this.socket = socket;
    this.heard = performance.now();
    socket.onmessage = (event) => {
      this.heard = performance.now();
      this.handlers.message(JSON.parse(event.data));
    };
    socket.onclose = () => {
      if (this.socket !== socket) return;
      this.handlers.lost();
      this.ask("api/state").catch((error) => {
        if (error.status === 401) this.handlers.refused();
      }).finally(() => setTimeout(() => this.connect(), RETRY_MS));
    };
  }

  watch() {
    if ((performance.now() - this.heard) / 1000 < LOST_S + 1) return;
    this.handlers.lost();
    if (this.socket.readyState === WebSocket.OPEN) this.socket.close();
  }

  use(token) {
    this.token = token;
    keep("token", token);
  }

  async ask(address, method = "GET", body = undefined) {
    const headers = this.token ? { Authorization: `Bearer ${this.token}` } : {};
    if (body !== undefined) headers["Content-Type"] = "application/json";
    const answer = await fetch(address, { method, headers, body: body === undefined ? body : JSON.stringify(body) });
    if (answer.ok) return answer;
    const known = await answer.json().catch(() => ({}));
    throw Object.assign(new Error(known.error ?? `answer ${answer.status}`), { status: answer.status });
  }
}

// From what stands behind # in the address, where it is taken away, or as it was kept.
function readToken() {
  const match = /(?:^#|&)token=([A-Za-z0-9_-]+)/.exec(location.hash);
  if (match) {
    history.replaceState(null, "", location.pathname + location.search + (location.hash.includes("widget") ? "#widget" : ""));
    keep("token", match[1]);
    return match[1];
  }
  return recall("token") ?? "";
}
