//! The choice of the messages to record.

use sinew_record::{Channel, Selection};
use sinew_runtime::{
    outcome::Ticket,
    tid::{NodeAddress, Tid},
};

use crate::{channels::is_unreported, names::Names};

/// The node of a recording, and the messages to record.
#[derive(Clone, Debug)]
pub struct Setup {
    /// The node that writes the journal.
    pub node: NodeAddress,
    /// The messages to record, of those in the journal: it has also those that other programs asked for.
    pub selection: Selection,
    /// The names that are known at the start.
    pub names: Names,
    /// Applications without a record of their messages, such as the recorder itself.
    pub left_out: Vec<Tid>,
}

impl Setup {
    /// Returns whether the messages of a channel are recorded; `to` is the destination of the first one.
    pub(crate) fn chooses(&self, channel: &Channel, to: Tid) -> bool {
        let Self { selection, names, left_out, .. } = self;
        let (source, destination, kind) = (channel.source, channel.destination, channel.kind);
        let ends = [source, destination];
        if left_out.iter().any(|app| ends.contains(app)) {
            return false;
        }
        if is_unreported(channel) {
            // Their types are not known.
            return selection.has_all_apps() || names.app(source).is_some_and(|name| selection.has_app(name));
        }
        if selection.is_all() {
            return true;
        }
        let kinds = names.type_name(kind).map(|name| (name, kind));
        let chosen = selection.chosen(self.named(ends), kinds);
        chosen.has(source, destination, kind) || chosen.has(source, to, kind)
    }

    /// Returns whether the outcome of a message is recorded. Its type is not known.
    pub(crate) fn chooses_outcome(&self, message: Ticket) -> bool {
        let Ticket { source, destination, .. } = message;
        let ends = [source, destination];
        if self.left_out.iter().any(|app| ends.contains(app)) {
            return false;
        }
        let Self { selection, .. } = self;
        selection.has_all_apps() || selection.chosen(self.named(ends), []).has_ends(source, destination)
    }

    fn named(&self, ends: [Tid; 2]) -> impl Iterator<Item = (&str, Tid)> {
        ends.into_iter().filter_map(|app| Some((self.names.app(app)?, app)))
    }
}
