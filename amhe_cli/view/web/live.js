// Frames and numbers that arrive while something runs.
class Live {
  constructor(player) {
    this.player = player; player.following = true;
    this.source = new EventSource("stream");
    this.source.onmessage = (event) => this.take(JSON.parse(event.data));
    this.source.onerror = () => this.note(this.heard ? "The run has ended, or its page is no longer served." : "No connection yet.");
    this.source.onopen = () => { this.heard = true; };
    setInterval(() => { if (this.news) { this.news = false; player.stale = true; } }, 200);
  }
  note(text) {
    if (this.said === text) return;
    this.said = text; this.source.close(); $("notes").append(made("li", { textContent: text }));
  }
  take(message) {
    const { player } = this, { track, ghosts } = player.recording;
    if (message.over) return this.note("The run has ended.");
    const was = player.end;
    if (message.poses) message.poses.forEach((text, i) => text && (i ? ghosts[i - 1] : track).push(floats(text), Math.round(message.time / track.step)));
    if (message.forces || message.traces) player.recording.drawn.set(Math.round(message.time / track.step), { forces: message.forces && floats(message.forces), traces: message.traces && floats(message.traces), points: message.points });
    for (const [name, [value, low, high]] of Object.entries(message.numbers ?? {})) {
      const line = player.recording.curves.get(name);
      if (!line) continue;
      line.times.push(message.time); line.values.push(value);
      if (low !== undefined) { line.lower ??= line.times.slice(1).map(() => NaN); line.upper ??= [...line.lower]; line.lower.push(low); line.upper.push(high); }
    }
    if (message.event) player.recording.events.push(message.time);
    if (!was && player.end) player.fit();
    if (message.poses && player.following) { player.now = player.end; player.dirty = true; }
    this.news = true;
  }
}
