//! The output of `sinew logs`: a line for each line of a node, for users or for programs.

use std::time::{Duration, SystemTime, UNIX_EPOCH};

use serde_json::json;
use sinew::Time;

use super::merge::{Content, Entry};
use crate::{
    output,
    table::{clean, clean_lines},
};

/// The output. Each method returns whether there is still a reader.
#[derive(Clone, Copy, Debug)]
pub(super) struct Screen {
    pub(super) is_json: bool,
}

/// The clock on the wall, beside the clock of the entry node.
#[derive(Clone, Copy, Debug)]
pub(super) struct Wall {
    pub(super) now: SystemTime,
    pub(super) at: Time,
}

impl Wall {
    /// Reads both clocks.
    #[expect(
        clippy::disallowed_methods,
        reason = "people compare the time of a line with a clock on the wall"
    )]
    pub(super) fn now() -> Self {
        Self { now: SystemTime::now(), at: Time::now() }
    }

    /// Returns the time on the wall for a time of the entry node.
    fn of(self, at_ns: u64) -> SystemTime {
        let ago = self.at.as_nanos().saturating_sub(at_ns);
        let ahead = at_ns.saturating_sub(self.at.as_nanos());
        let before = self.now.checked_sub(Duration::from_nanos(ago)).unwrap_or(UNIX_EPOCH);
        // A date before 1970 has no text.
        before.checked_add(Duration::from_nanos(ahead)).unwrap_or(self.now).max(UNIX_EPOCH)
    }
}

impl Screen {
    pub(super) fn entry(self, wall: Wall, name: &str, entry: &Entry) -> bool {
        let at = wall.of(entry.at_ns);
        if self.is_json {
            output::line(&json_of(at, name, entry))
        } else {
            output::print(&text_of(at, name, entry))
        }
    }

    /// Shows that a node is not read any more, with the reason, or that it is again.
    pub(super) fn state(self, node: &str, name: &str, fault: Option<&str>) -> bool {
        let label = clean(&format!("{node} {name}"));
        match fault {
            Some(why) => {
                output::note(format_args!("sinew: {} cannot be asked: {}", label.trim_end(), clean(why)))
            }
            None => output::note(format_args!("sinew: {} answers again", label.trim_end())),
        }
        let event = if fault.is_some() { "silent" } else { "answers" };
        !self.is_json
            || output::line(
                &json!({ "event": event, "node": name, "address": node, "fault": fault }).to_string(),
            )
    }
}

fn text_of(at: SystemTime, name: &str, entry: &Entry) -> String {
    let label = if name.is_empty() { entry.node.to_string() } else { clean(name) };
    match &entry.content {
        Content::Lost(count) => {
            let lines = if *count == 1 { "1 line was".to_owned() } else { format!("{count} lines were") };
            format!("-- {lines} lost at node {label}\n")
        }
        Content::Line { level, target, text } => {
            let time = humantime::format_rfc3339_millis(at);
            let (level, target) = (clean(level).to_uppercase(), clean(target));
            // The further lines of a text are indented, so that none looks like a line of its own.
            let text = clean_lines(text).replace('\n', "\n    ");
            format!("{time} {level:>5} {label} {target}: {text}\n")
        }
    }
}

fn json_of(at: SystemTime, name: &str, entry: &Entry) -> String {
    let time_s = at.duration_since(UNIX_EPOCH).unwrap_or_default().as_secs_f64();
    let address = entry.node.to_string();
    let json = match &entry.content {
        Content::Lost(count) => {
            json!({ "event": "lost", "time_s": time_s, "node": name, "address": address, "count": count })
        }
        Content::Line { level, target, text } => json!({
            "event": "line", "time_s": time_s, "node": name, "address": address, "number": entry.number,
            "level": level, "target": target, "text": text,
        }),
    };
    json.to_string()
}

#[cfg(test)]
mod tests {
    use sinew::NodeAddress;

    use super::*;

    const WALL: Wall = Wall { now: SystemTime::UNIX_EPOCH, at: Time::from_nanos(5_000_000_000) };

    fn entry(at_ns: u64, content: Content) -> Entry {
        Entry { at_ns, node: NodeAddress::new(0x0a00_0002), number: 7, content }
    }

    fn line(text: &str) -> Content {
        let [level, target] = ["warn", "sinew::gncl"].map(str::to_owned);
        Content::Line { level, target, text: text.to_owned() }
    }

    #[test]
    fn line_has_time_level_node_target_and_text() {
        let wall = Wall { now: UNIX_EPOCH + Duration::from_millis(1_790_000_000_123), ..WALL };
        let at = wall.of(4_000_000_000);
        let shown = text_of(at, "knee", &entry(0, line("it broke\nERROR \u{1b}[31mforged")));
        assert_eq!(
            shown,
            "2026-09-21T14:13:19.123Z  WARN knee sinew::gncl: it broke\n    ERROR \\u{1b}[31mforged\n"
        );
        let json: serde_json::Value =
            serde_json::from_str(&json_of(at, "knee", &entry(0, line("x")))).unwrap();
        assert_eq!(
            (&json["event"], &json["node"], &json["number"]),
            (&"line".into(), &"knee".into(), &7.into())
        );
        assert_eq!(json["time_s"].as_f64().map(f64::floor), Some(1_789_999_999.0));
    }

    #[test]
    fn gap_names_the_node_and_the_count() {
        assert_eq!(
            text_of(UNIX_EPOCH, "knee", &entry(0, Content::Lost(3))),
            "-- 3 lines were lost at node knee\n"
        );
        assert_eq!(
            text_of(UNIX_EPOCH, "", &entry(0, Content::Lost(1))),
            "-- 1 line was lost at node 10.0.0.2\n"
        );
    }

    #[test]
    fn times_beyond_the_clock_do_not_overflow() {
        assert_eq!(WALL.of(0), UNIX_EPOCH);
        assert_eq!(WALL.of(6_000_000_000), UNIX_EPOCH + Duration::from_secs(1));
        assert!(WALL.of(u64::MAX) > UNIX_EPOCH);
    }
}
