//! What this node says about itself, and to whom it goes when.

use bytes::Bytes;
use sinew_runtime::time::Time;

use super::{Core, Output, peers::spacing};
use crate::sync::list::{ENTRIES_MAX, List, Published};

impl Core {
    pub(super) fn groups_changed(&mut self, now: Time, published: Published) {
        let Published { mut groups, own, .. } = published;
        let own = groups.iter().take(own).filter(|group| group.is_group()).count();
        groups.retain(|group| group.is_group());
        if (self.own_groups, &self.groups) != (own, &groups) {
            (self.own_groups, self.groups) = (own, groups);
            self.own_list_changed(now);
        }
    }

    pub(super) fn own_list_changed(&mut self, now: Time) {
        self.version += 1;
        self.encoded = None;
        // With the groups and phases in it, of which the directory says nothing; they seldom change.
        self.directory_changed();
        self.peers.make_due(now, self.spacing);
    }

    /// Sends the list to whom it is due. spec: SYNC-2
    pub(super) fn publish(&mut self, now: Time) {
        for to in self.peers.take_due(now) {
            let list = self.encoded();
            self.outputs.push_back(Output::Publish { to, list });
        }
    }

    fn encoded(&mut self) -> Bytes {
        if let Some(bytes) = &self.encoded {
            return bytes.clone();
        }
        let list = List {
            incarnation: self.incarnation,
            version: self.version,
            entries: self.apps.entries(),
            groups: self.groups.clone(),
        };
        let (bytes, left_out) = list.encode_within(self.list_bytes_max, self.own_groups);
        if left_out > 0 {
            let limit = self.list_bytes_max;
            let detail = format!(
                "{left_out} applications and groups are not in this node's directory, which has at most {ENTRIES_MAX} \
                 applications and {limit} bytes: other nodes cannot find them; raise `node.payload_max` or use more nodes"
            );
            self.refuse("directory full", detail);
        }
        (self.encoded, self.spacing) = (Some(bytes.clone()), spacing(bytes.len()));
        bytes
    }
}
