//! The channels that every recording has: tallies, clocks and events, as JSON.

use std::fmt::Write as _;

use serde_json::json;

use super::channel::Channel;
use crate::{
    messagepack::{DEPTH_MAX, MisfitError, Reader, Token, base64, json, json_members},
    terms::{ClockReading, Event, EventTopic, Level, Origin, Record},
};

/// The topic of tallies.
pub(crate) const TALLY_TOPIC: &str = "/sinew/tally";
/// The topic of clock readings.
pub(crate) const CLOCK_TOPIC: &str = "/sinew/clock";

/// A channel with JSON.
#[derive(Debug)]
pub(super) struct Fixed {
    pub(super) topic: &'static str,
    /// The name of the schema.
    pub(super) schema: &'static str,
    pub(super) json_schema: &'static str,
}

/// The counters of channels. A channel that is not named has those of the tally before.
pub(super) const TALLY: Fixed = Fixed {
    topic: TALLY_TOPIC,
    schema: "sinew.Tally",
    json_schema: r#"{"type":"object","properties":{"part":{"type":"integer"},"is_whole":{"type":"boolean"},"events_lost":{"type":"integer"},"channels":{"type":"array","items":{"type":"object","properties":{"topic":{"type":"string"},"seen":{"type":"integer"},"written":{"type":"integer"},"dropped":{"type":"integer"},"misfits":{"type":"integer"}}}}}}"#,
};

/// The clocks of other nodes.
pub(super) const CLOCK: Fixed = Fixed {
    topic: CLOCK_TOPIC,
    schema: "sinew.Clock",
    json_schema: r#"{"type":"object","properties":{"peer":{"type":"string"},"name":{"type":"string"},"incarnation":{"type":"integer"},"at_ns":{"type":"integer"},"offset_ns":{"type":"integer"},"bound_ns":{"type":"integer"},"drift_ppb":{"type":"integer"},"drift_bound_ppb":{"type":"integer"}}}"#,
};

/// The schema that the tools of the field have for log lines, and a field for data.
const LOG: &str = r#"{"type":"object","title":"foxglove.Log","properties":{"timestamp":{"type":"object","title":"time","properties":{"sec":{"type":"integer","minimum":0},"nsec":{"type":"integer","minimum":0,"maximum":999999999}}},"level":{"type":"integer","oneOf":[{"title":"UNKNOWN","const":0},{"title":"DEBUG","const":1},{"title":"INFO","const":2},{"title":"WARNING","const":3},{"title":"ERROR","const":4},{"title":"FATAL","const":5}]},"message":{"type":"string"},"name":{"type":"string"},"file":{"type":"string"},"line":{"type":"integer","minimum":0},"data":{"type":"object"}}}"#;

static EVENTS: [Fixed; 4] =
    [log(EventTopic::Events), log(EventTopic::Barriers), log(EventTopic::Outcomes), log(EventTopic::Log)];

const fn log(topic: EventTopic) -> Fixed {
    Fixed { topic: topic.topic(), schema: "foxglove.Log", json_schema: LOG }
}

/// Returns every channel that a recording has besides those of messages.
pub(super) fn all() -> impl Iterator<Item = &'static Fixed> {
    static TALLY_AND_CLOCK: [Fixed; 2] = [TALLY, CLOCK];
    TALLY_AND_CLOCK.iter().chain(&EVENTS)
}

pub(super) fn of_topic(topic: EventTopic) -> &'static Fixed {
    match topic {
        EventTopic::Events => &EVENTS[0],
        EventTopic::Barriers => &EVENTS[1],
        EventTopic::Outcomes => &EVENTS[2],
        EventTopic::Log => &EVENTS[3],
    }
}

/// Returns the event of messages that the recorder did not get.
pub(super) fn gap<'e>(text: &'e str, data: &'e serde_json::Value, at_ns: u64) -> Event<'e> {
    Event { topic: EventTopic::Events, at_ns, level: Level::Warning, name: "recorder", text, data }
}

/// Returns a tally: of all channels if `is_whole`, else of those with other counters than in the tally before.
pub(super) fn tally<'c>(
    channels: impl IntoIterator<Item = &'c mut Channel>,
    part: u32,
    events_lost: u64,
    is_whole: bool,
) -> String {
    let mut named = Vec::new();
    for channel in channels {
        if is_whole || channel.tallied != Some(channel.counts) {
            channel.tallied = Some(channel.counts);
            let counts = channel.counts;
            named.push(json!({
                "topic": channel.topic, "seen": counts.seen, "written": counts.written,
                "dropped": counts.dropped, "misfits": counts.misfits,
            }));
        }
    }
    json!({ "part": part, "is_whole": is_whole, "events_lost": events_lost, "channels": named }).to_string()
}

pub(super) fn clock(origin: &Origin, now_ns: u64, reading: &ClockReading) -> String {
    json!({
        "peer": reading.peer, "name": reading.name, "incarnation": reading.incarnation,
        "at_ns": origin.wall_ns(now_ns), "offset_ns": reading.offset_ns, "bound_ns": reading.bound_ns,
        "drift_ppb": reading.drift_ppb, "drift_bound_ppb": reading.drift_bound_ppb,
    })
    .to_string()
}

pub(super) fn event(origin: &Origin, event: &Event<'_>) -> String {
    let at = origin.wall_ns(event.at_ns);
    json!({
        "timestamp": { "sec": at / 1_000_000_000, "nsec": at % 1_000_000_000 },
        "level": event.level.number(), "message": event.text, "name": event.name, "file": "", "line": 0,
        "data": event.data,
    })
    .to_string()
}

/// Returns the view of a payload without a schema: its members, or its value as `value`, and the header. Bytes that are
/// no MessagePack are in base64, as `bytes`.
pub(super) fn json_view(record: &Record<'_>) -> String {
    let mut text = String::from("{");
    if members(record.value(), &mut text).is_err() {
        text.truncate(1);
        let _ = write!(text, "\"bytes\":\"{}\"", base64(record.value()));
    }
    if text.len() > 1 {
        text.push(',');
    }
    let age_ns = record.handed_over_ns.wrapping_sub(record.sent_ns) as i64;
    let Record { number, sequence, correlation, flags, sent_error_ns, time_to_live_us, .. } = record;
    let _ = write!(
        text,
        "\"sinew\":{{\"sequence\":{sequence},\"correlation\":{correlation},\"number\":{number},\"age_ns\":{age_ns},\
         \"error_ns\":{sent_error_ns},\"flags\":{flags},\"time_to_live_us\":{time_to_live_us}}}}}"
    );
    text
}

fn members(payload: &[u8], text: &mut String) -> Result<(), MisfitError> {
    let mut reader = Reader::new(payload);
    let mut ahead = reader;
    if let Token::Map(count) = ahead.next()? {
        reader = ahead;
        json_members(&mut reader, count, DEPTH_MAX, text)?;
    } else {
        text.push_str("\"value\":");
        json(&mut reader, DEPTH_MAX, text)?;
    }
    if reader.is_empty() { Ok(()) } else { Err(MisfitError::new("one value only")) }
}
