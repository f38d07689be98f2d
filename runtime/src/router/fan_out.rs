//! The copies of a message to many for the applications of this node.

use std::sync::Arc;

use super::{Copies, Judge, MessageSink, Router, Snapshot, copy_of, tap};
use crate::{
    outcome::Rejection,
    tid::{AppAddress, Tid},
    wire::Message,
};

impl Router {
    /// Submits copies to the members on this node, except the sender itself.
    pub(super) fn fan_out(&self, snapshot: &Snapshot, judge: Judge<'_>, message: &Message) -> Copies {
        let mut copies = Copies::default();
        let here = self.node;
        for_each_here(snapshot, message.header.destination.app, |member, sink| {
            let is_sender = here == message.header.source.node && member == message.header.source.app;
            if !is_sender {
                copies.note(self.copy_to_member(snapshot, judge, (member, sink), message));
            }
        });
        copies
    }

    /// Submits a copy to a member on this node, if the guard allows it. Returns the reason of a rejection.
    pub(super) fn copy_to_member(
        &self,
        snapshot: &Snapshot,
        judge: Judge<'_>,
        (member, sink): (AppAddress, &Arc<dyn MessageSink>),
        message: &Message,
    ) -> Option<Rejection> {
        let refused = judge
            .why_refused(member, &message.header)
            .or_else(|| sink.submit(copy_of(message)).err().map(|refused| refused.why));
        tap::saw_one_of_many(snapshot.table.tap.as_ref(), Tid::new(self.node, member), message, refused);
        refused
    }
}

/// Calls `each` for the applications of this node that a message to many reaches, in the order of their addresses.
pub(super) fn for_each_here(
    snapshot: &Snapshot,
    of: AppAddress,
    mut each: impl FnMut(AppAddress, &Arc<dyn MessageSink>),
) {
    let Snapshot { table, members } = snapshot;
    if of.is_group() {
        let routes = members.here.members(of).iter().filter_map(|app| Some((*app, table.local.get(app)?)));
        routes.for_each(|(app, route)| each(app, &route.sink));
    } else if of == AppAddress::ALL {
        let apps = table.local.iter().filter(|(app, _)| !app.is_layer());
        apps.for_each(|(app, route)| each(*app, &route.sink));
    } else if let Some(route) = table.local.get(&of) {
        // A broadcast to the application that has this address on every node.
        each(of, &route.sink);
    }
}
