//! A channel of the journal, and its description in the file.

use std::sync::Arc;

use sinew_bag::{ChannelId, ChannelInfo, Class, Direction, Party, Record};
use sinew_record::{Channel, MessageEntry, lost_channel};
use sinew_runtime::{
    protection::unsealed,
    tid::{NodeAddress, Tid},
    wire::{self, Flags},
};
use sinew_schema::Schema;

use crate::{
    names::Names,
    order::{Order, Step},
    sink::Sink,
};

/// Bytes of a held message beside its payload, about.
const HELD_BYTES: usize = 128;

/// A place of the journal's table.
#[derive(Debug)]
pub(crate) enum Place {
    /// Its messages are recorded.
    Recorded(Recorded),
    /// They are not. The names may decide otherwise once they have changed.
    Unchosen { changes: u64 },
}

/// A channel that is recorded.
#[derive(Debug)]
pub(crate) struct Recorded {
    id: ChannelId,
    pub(crate) order: Order<Held>,
    /// When its last message was handed over, or its recording began.
    last_ns: u64,
}

/// A message that waits for those before it.
#[derive(Debug)]
pub(crate) struct Held {
    /// Without its payload.
    record: Record<'static>,
    /// `None` if the journal does not have it.
    payload: Option<Vec<u8>>,
}

impl Held {
    pub(crate) fn new(record: Record<'static>, payload: Option<&[u8]>) -> Self {
        Self { record, payload: payload.map(<[u8]>::to_vec) }
    }

    pub(crate) fn bytes(&self) -> usize {
        HELD_BYTES + self.payload.as_ref().map_or(0, Vec::len)
    }

    pub(crate) const fn at_ns(&self) -> u64 {
        self.record.handed_over_ns
    }
}

impl Recorded {
    pub(crate) const fn new(id: ChannelId, seen_before: u64, now_ns: u64) -> Self {
        Self { id, order: Order::after(seen_before), last_ns: now_ns }
    }

    /// Writes the message of the number that was passed just now.
    pub(crate) fn write(&mut self, sink: &mut Sink, record: &Record<'static>, payload: Option<&[u8]>) {
        match payload {
            Some(payload) => {
                // The envelope of a protected payload stays as it was sent; the view is of the value in it.
                let inner = unsealed(payload).map(|unsealed| unsealed.payload);
                sink.message(self.id, &Record { payload, inner, ..*record });
            }
            // It is known that it was there, and no more.
            None => sink.dropped(self.id, 1, (self.last_ns, record.handed_over_ns)),
        }
        self.last_ns = record.handed_over_ns;
    }

    /// Writes the held messages that are next; with `gives_up` all of them. Returns how many bytes are held less.
    pub(crate) fn release(&mut self, sink: &mut Sink, gives_up: bool) -> usize {
        let mut bytes = 0;
        while let Some(step) = self.order.step(gives_up) {
            match step {
                Step::Missing(count) => {
                    let until_ns = self.order.first_held().map_or(self.last_ns, Held::at_ns);
                    sink.dropped(self.id, count, (self.last_ns, until_ns));
                }
                Step::Next(held) => {
                    bytes += held.bytes();
                    self.write(sink, &held.record, held.payload.as_deref());
                }
            }
        }
        bytes
    }

    /// Counts all messages up to this number as dropped that were not passed. None may be held.
    pub(crate) fn skip_to(&mut self, sink: &mut Sink, number: u64, now_ns: u64) {
        let count = self.order.skip_to(number);
        sink.dropped(self.id, count, (self.last_ns, now_ns));
    }
}

/// Returns a message of the journal as one of the file, without its payload.
pub(crate) fn record(number: u64, time: u64, message: &MessageEntry<'_>) -> Record<'static> {
    let header = &message.header;
    let flags = [Flags::CONFIRM, Flags::ASK, Flags::REPLY, Flags::OUTCOME, Flags::KEEP, Flags::RETAINED];
    let flags = (0_u8..).zip(flags).map(|(bit, flag)| u8::from(header.flags.has(flag)) << bit);
    let nanos = |time: std::time::Duration| u64::try_from(time.as_nanos()).unwrap_or(u64::MAX);
    Record {
        number,
        sequence: header.sequence,
        correlation: header.correlation,
        flags: flags.fold(0, |all, flag| all | flag),
        sent_ns: header.sent.as_nanos(),
        // `None`: the clock of the sender was not measured, so its time may be wrong by any span.
        sent_error_ns: header.sent_error().map_or(u64::MAX, nanos),
        handed_over_ns: time,
        time_to_live_us: header.time_to_live_us,
        payload: &[],
        inner: None,
    }
}

/// Returns whether it counts the messages that an application's process could not report.
pub(crate) fn is_unreported(channel: &Channel) -> bool {
    *channel == lost_channel(channel.source)
}

/// The description of a channel in the file.
#[derive(Debug)]
pub(crate) struct Description {
    source: Party,
    destination: Party,
    type_name: String,
    kind: u32,
    class: Class,
    direction: Direction,
    is_protected: bool,
    schema: Option<Arc<Schema>>,
    refused: Option<String>,
}

impl Description {
    /// Describes a channel. `first` is the payload of its first message, if the journal has it: an envelope says that
    /// the payloads are protected.
    pub(crate) fn of(channel: &Channel, first: Option<&[u8]>, node: NodeAddress, names: &Names) -> Self {
        let unnamed = || channel.kind.to_string();
        let type_name = if is_unreported(channel) {
            "unreported".to_owned()
        } else {
            names.type_name(channel.kind).map_or_else(unnamed, str::to_owned)
        };
        Self {
            source: party(channel.source, names),
            destination: party(channel.destination, names),
            type_name,
            kind: channel.kind.bits(),
            class: match channel.class {
                wire::Class::Control => Class::Control,
                wire::Class::Stream => Class::Stream,
                wire::Class::Bulk => Class::Bulk,
            },
            direction: if channel.source.node == node { Direction::Sent } else { Direction::Received },
            is_protected: first.is_some_and(|first| unsealed(first).is_some()),
            schema: names.schema(channel.kind).cloned(),
            refused: channel.refused.map(|why| format!("{why:?}")),
        }
    }

    /// Describes the place that all channels share which found none of their own in the journal's table.
    pub(crate) fn shared() -> Self {
        let party = || Party { text: "several".to_owned(), ..Party::default() };
        Self {
            source: party(),
            destination: party(),
            type_name: "several".to_owned(),
            kind: 0,
            class: Class::Control,
            direction: Direction::Sent,
            is_protected: false,
            schema: None,
            refused: None,
        }
    }

    pub(crate) fn info(&self, seen_before: u64) -> ChannelInfo<'_> {
        ChannelInfo {
            source: &self.source,
            destination: &self.destination,
            type_name: &self.type_name,
            kind: self.kind,
            class: self.class,
            direction: self.direction,
            is_protected: self.is_protected,
            schema: self.schema.as_deref(),
            refused: self.refused.as_deref(),
            seen_before,
        }
    }
}

/// Describes one end of a message.
pub(crate) fn party(tid: Tid, names: &Names) -> Party {
    // A group has its name on all nodes.
    let named = if tid.app.is_group() { Tid::new(NodeAddress::ALL, tid.app) } else { tid };
    let is_one = tid.is_single() && tid.node.is_single();
    Party {
        tid: tid.bits(),
        text: tid.to_string(),
        name: names.app(named).map(str::to_owned),
        node: is_one.then(|| tid.node.to_string()),
    }
}
