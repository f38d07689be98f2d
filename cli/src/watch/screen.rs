//! The output of `sinew watch`: a line for each message, and the rates.

use std::{
    collections::BTreeMap,
    time::{Duration, Instant, SystemTime, UNIX_EPOCH},
};

use serde_json::{Value, json};
use sinew::{
    NodeAddress, Tid,
    inspect::{AppsReport, AskApps, SeenMessage},
    protection::unsealed,
};

use super::rates::Rated;
use crate::{
    messagepack, output,
    system::{Answer, System, SystemError},
    table::{clean, lines, paragraph, time},
};

/// Columns of a message's line, at most 120 with the gaps; with `--wide` as long as its cells.
const COLUMNS: [usize; 6] = [13, 20, 15, 24, 9, 29];
/// Spaces before a line of rates.
const RATES_INDENT: usize = 3;

/// The names of the current nodes and applications.
#[derive(Default)]
pub(super) struct Names {
    apps: BTreeMap<Tid, String>,
    nodes: BTreeMap<NodeAddress, String>,
}

impl Names {
    pub(super) fn asked(system: &mut System) -> Result<Self, SystemError> {
        let here = system.here()?;
        Ok(Self::of(system.ask_all::<AskApps, AppsReport>(&here)))
    }

    pub(super) fn of(answers: Vec<Answer<AppsReport>>) -> Self {
        let mut names = Self::default();
        for Answer { node, name, result } in answers {
            // A lost node has no name at the other nodes any more.
            if !name.is_empty() {
                names.nodes.insert(node, name);
            }
            let apps = result.into_iter().flat_map(|report| report.apps);
            names.apps.extend(apps.filter_map(|app| Some((app.tid, app.name?))));
        }
        names
    }

    /// Returns the label of a node in the output.
    pub(super) fn of_node(&self, node: NodeAddress) -> String {
        let name = self.nodes.get(&node);
        name.map_or_else(|| node.to_string(), |name| format!("{} at {node}", clean(name)))
    }
}

/// The output. Each method returns whether there is still a reader.
pub(super) struct Screen {
    pub(super) names: Names,
    pub(super) is_json: bool,
    pub(super) is_wide: bool,
    pub(super) rates_only: bool,
}

impl Screen {
    pub(super) fn heading(&self, target: &str, app: Tid) {
        if !self.is_json {
            let target = clean(target);
            output::note(format_args!(
                "{target} ({app}): received (->) and sent (<-) messages; Ctrl-C ends it"
            ));
        }
    }

    pub(super) fn message(&self, began: Instant, message: &SeenMessage) -> bool {
        if self.rates_only {
            return true;
        }
        if self.is_json {
            return output::line(&self.message_json(message).to_string());
        }
        let seen = began.elapsed().saturating_sub(Duration::from_micros(message.seen_us));
        output::print(&self.message_text(seen, message))
    }

    /// Returns the time since the start, the direction, type, class, other end, age and payload.
    fn message_text(&self, seen: Duration, message: &SeenMessage) -> String {
        let (arrow, other) = if message.is_sent { ("<-", message.target) } else { ("->", message.source) };
        let wants = message.wants.as_ref().map_or_else(String::new, |wants| format!(" {wants}"));
        let refused =
            message.refused.map_or_else(String::new, |refused| format!("  REFUSED {refused:?}: {refused}"));
        let [kind, class, other] = [
            kind(message),
            format!("{:?}{wants}", message.class),
            self.names.apps.get(&other).cloned().unwrap_or_else(|| other.to_string()),
        ]
        .map(|cell| clean(&cell));
        let (seen, age) = (seen.as_secs_f64(), age(message));
        let payload = clean(&format!("{}{refused}", payload(message)));
        if self.is_wide {
            return format!("{seen:>9.3} {arrow} {kind:<20} {class:<15} {other:<20} {age:>9}  {payload}\n");
        }
        let cells = [format!("{seen:>9.3} {arrow}"), kind, class, other, format!("{age:>9}"), payload];
        lines(&cells, &COLUMNS)
    }

    fn message_json(&self, message: &SeenMessage) -> Value {
        let (counter, payload) = if is_whole(message) { value(&message.payload) } else { Default::default() };
        json!({
            "event": "message", "time_s": since_1970(Duration::from_micros(message.seen_us)), "sent": message.is_sent, "kind": kind(message), "kind_id": message.kind.to_string(),
            "class": format!("{:?}", message.class).to_lowercase(), "wants": message.wants,
            "source": message.source.to_string(), "source_name": self.names.apps.get(&message.source),
            "target": message.target.to_string(), "target_name": self.names.apps.get(&message.target),
            "sequence": message.sequence, "age_ns": message.age_ns, "age_error_ns": message.age_error_ns, "bytes": message.length,
            "refused": message.refused.map(|refused| format!("{refused:?}")),
            "protected": counter.map(|counter| json!({ "counter": counter })),
            "payload": payload,
        })
    }

    pub(super) fn rates(&self, rates: &Rated) -> bool {
        if self.is_json {
            output::line(&rates.json(since_1970(Duration::ZERO)).to_string())
        } else {
            output::print(&paragraphs(&rates.text(), self.is_wide))
        }
    }
}

/// Returns when a message was recorded this long ago, in seconds since 1970 by the clock of this host.
#[expect(clippy::disallowed_methods, reason = "people compare the time of a line with a clock on the wall")]
fn since_1970(ago: Duration) -> f64 {
    let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    now.saturating_sub(ago).as_secs_f64()
}

pub(super) fn kind(message: &SeenMessage) -> String {
    message.name.clone().unwrap_or_else(|| message.kind.to_string())
}

/// Returns the age of a message; unknown if the clock of the sender's node is not measured.
fn age(message: &SeenMessage) -> String {
    message.age_ns.map_or_else(|| "?".to_owned(), |age_ns| time(age_ns / 1_000))
}

const fn is_whole(message: &SeenMessage) -> bool {
    message.payload.len() as u64 == message.length
}

fn payload(message: &SeenMessage) -> String {
    if !is_whole(message) {
        return format!("({} bytes, too long to be shown)", message.length);
    }
    match value(&message.payload) {
        (Some(counter), value) => format!("protected #{counter} {value}"),
        (None, value) => value.to_string(),
    }
}

/// Returns the value of a payload, and the counter of a protected one.
fn value(payload: &[u8]) -> (Option<u64>, Value) {
    let unsealed = unsealed(payload);
    let inner = unsealed.map_or(payload, |unsealed| unsealed.payload);
    (unsealed.map(|unsealed| unsealed.counter), messagepack::shown_or_raw(inner))
}

/// The lines of rates.
fn paragraphs(text: &str, is_wide: bool) -> String {
    let line = |line: &str| paragraph(RATES_INDENT, &clean(line.trim_start()), is_wide);
    text.lines().map(line).collect()
}

#[cfg(test)]
mod tests {
    use sinew::{
        AppAddress, Class, Time,
        message::{Kind, Rejection},
        protection::{DataId, Stamp, seal},
    };

    use super::{super::rates::Rates, *};
    use crate::table::{
        WIDTH,
        tests::{long_name, widest},
    };

    const HIP: NodeAddress = NodeAddress::new(0x0a00_0001);
    const KNEE: NodeAddress = NodeAddress::new(0x0a00_0002);

    /// A message from the hip to the knee with this payload.
    fn seen(payload: Vec<u8>) -> SeenMessage {
        let tid = |node| Tid::new(node, AppAddress::new(0x1001));
        SeenMessage {
            seen_us: 0,
            age_ns: Some(1_000),
            age_error_ns: Some(0),
            is_sent: true,
            source: tid(HIP),
            target: tid(KNEE),
            kind: Kind::named("demo.angle"),
            name: Some("demo.angle".to_owned()),
            class: Class::Stream,
            sequence: 9,
            wants: None,
            length: payload.len() as u64,
            payload,
            refused: None,
        }
    }

    /// In an envelope, as message 103 of this type from the hip.
    fn sealed(payload: &[u8]) -> Vec<u8> {
        let SeenMessage { source, target, .. } = seen(Vec::new());
        let data_id = DataId { source, destination: target, name: "demo.angle" };
        let stamp = Stamp { counter: 103, incarnation: 7, echo: Time::ZERO };
        seal(&data_id, stamp, payload).to_vec()
    }

    fn screen() -> Screen {
        Screen { names: Names::default(), is_json: true, is_wide: false, rates_only: false }
    }

    #[test]
    fn lines_fit_a_terminal_unless_wide() {
        let name = long_name();
        let tid = seen(Vec::new()).target;
        let mut screen = screen();
        screen.names.apps.insert(tid, name.clone());
        let long = json!({ "words": "word ".repeat(40), "bytes": "0".repeat(300) });
        let message = SeenMessage {
            name: Some(name.clone()),
            wants: Some("confirm".to_owned()),
            refused: Some(Rejection::Malformed),
            ..seen(messagepack::written(&long).unwrap())
        };
        let text = screen.message_text(Duration::from_secs(7), &message);
        assert!(widest(&text) <= WIDTH && text.contains("REFUSED"), "{text}");
        let mut rates = Rates::default();
        rates.add(&message);
        let rates = rates.end(Duration::from_secs(1)).text();
        assert!(widest(&paragraphs(&rates, false)) <= WIDTH, "{rates}");
        screen.is_wide = true;
        let wide = screen.message_text(Duration::from_secs(7), &message);
        assert!(wide.lines().count() == 1 && wide.contains(&name), "{wide}");
        // And: a short message is one line.
        screen.is_wide = false;
        let angle = messagepack::written(&json!({ "degrees": 1.5 })).unwrap();
        let short = SeenMessage { is_sent: false, ..seen(angle) };
        let line = screen.message_text(Duration::from_millis(1_500), &short);
        assert_eq!(
            line.split_whitespace().collect::<Vec<_>>(),
            ["1.500", "->", "demo.angle", "Stream", "10.0.0.1/1001", "1", "us", "{\"degrees\":1.5}"]
        );
        assert_eq!(line.lines().count(), 1);
    }

    #[test]
    fn protected_payload_is_decoded_with_its_counter() {
        let angle = json!({ "degrees": 1.5 });
        let message = seen(sealed(&messagepack::written(&angle).unwrap()));
        // As text
        assert_eq!(payload(&message), r#"protected #103 {"degrees":1.5}"#);
        // As JSON: the counter is not the sequence number from the source
        let shown = screen().message_json(&message);
        assert_eq!((&shown["protected"], &shown["payload"]), (&json!({ "counter": 103 }), &angle));
        assert_eq!(shown["sequence"], 9);
        // And: content other than MessagePack, as between programs in C, is shown as bytes
        assert_eq!(payload(&seen(sealed(&[1, 2]))), r#"protected #103 {"bytes":"0102"}"#);
    }

    #[test]
    fn payload_without_envelope_is_not_called_protected() {
        let angle = json!({ "degrees": 1.5 });
        let message = seen(messagepack::written(&angle).unwrap());
        assert_eq!(payload(&message), r#"{"degrees":1.5}"#);
        let shown = screen().message_json(&message);
        assert_eq!((&shown["protected"], &shown["payload"]), (&Value::Null, &angle));
        // This envelope lacks one byte.
        let mut cut = sealed(&[0x80]);
        cut.pop();
        assert!(payload(&seen(cut)).starts_with(r#"{"bytes":"0100000001"#));
        // And: a payload that was too long to be copied is not judged.
        let long = SeenMessage { length: 1 << 20, ..seen(Vec::new()) };
        assert_eq!(screen().message_json(&long)["payload"], Value::Null);
        assert_eq!(payload(&long), "(1048576 bytes, too long to be shown)");
    }
}
