// What this browser remembers between visits.

export function recall(name) {
  try { return localStorage.getItem(`rovgraph-${name}`); } catch { return null; }
}

export function keep(name, value) {
  try { localStorage.setItem(`rovgraph-${name}`, value); } catch { /* a browser that keeps nothing asks again */ }
}
