//! Checks whether values of class Stream use UDP or the connection, and why.

use sinew::inspect::StreamReport;

use super::{Steps, TrafficEnd, keys::has_keys};

impl Steps {
    /// Adds the step of values from `from` to `to`. `after` contains the counts after a value was sent.
    pub(super) fn streamed(&mut self, from: &TrafficEnd, to: &TrafficEnd, after: Option<&StreamReport>) {
        let peer = to.node.and_then(|node| from.peer(node));
        // Without a connection no values are sent.
        let Some(peer) =
            peer.filter(|peer| !peer.links.is_empty() && peer.links.iter().all(|link| link.is_up))
        else {
            return;
        };
        let what = format!("class Stream from {} to {}", from.label(), to.label());
        let Some(before) = &peer.stream else { return };
        // Before the other checks: no setting enables datagrams between these nodes, so none is suggested.
        if !before.is_agreed && both_have_keys(from, to) {
            return self.fine(what, "by the connection (TCP), as nodes with keys do");
        }
        if !before.is_on {
            let fix =
                format!("`datagrams = true` under [gncl] of {}, where UDP gets through", from.node_label());
            return self.note(what, "by the connection (TCP): datagrams are switched off here", fix);
        }
        if !before.is_agreed {
            let fix = format!(
                "`datagrams = true` under [gncl] of {}; if it is so, its version knows none",
                to.node_label()
            );
            return self.note(what, "by the connection (TCP): the other end takes no datagrams", fix);
        }
        if let Some(payload_max) = after.unwrap_or(before).payload_max {
            let detail = format!(
                "values of up to {payload_max} bytes by datagram (UDP), longer ones by the connection (TCP): longer datagrams do not arrive"
            );
            return self.note(what, detail, long_packets(from, to));
        }
        let Some(after) = after else {
            let StreamReport { sent, arrived, .. } = before;
            return self
                .fine(what, format!("{sent} values by datagram (UDP) so far, {arrived} acknowledged"));
        };
        if after.arrived > before.arrived {
            return self.fine(what, "by datagram (UDP)");
        }
        self.note(what, "by the connection (TCP): no datagram is answered", blocked(from, to));
    }
}

/// Returns whether both have keys. A node that does not report it has keys if the other one has: they are connected,
/// and nodes with and without keys refuse each other.
fn both_have_keys(from: &TrafficEnd, to: &TrafficEnd) -> bool {
    let keys = |end: &TrafficEnd| end.report.as_ref().and_then(has_keys);
    match (keys(from), keys(to)) {
        (Some(one), Some(other)) => one && other,
        (Some(either), None) | (None, Some(either)) => either,
        (None, None) => false,
    }
}

/// Returns the fix that lets long packets through.
fn long_packets(from: &TrafficEnd, to: &TrafficEnd) -> String {
    format!(
        "give the interfaces of {}, of {} and of all between them one MTU (`ip link` shows it, `sudo ip link set eth0 mtu 1500` sets it), and let ICMP \
         \"packet too big\" through every firewall",
        from.node_label(),
        to.node_label()
    )
}

/// Returns the fix that lets datagrams through.
fn blocked(from: &TrafficEnd, to: &TrafficEnd) -> String {
    // A node reads them at the port of its connections, if that is free.
    let port = |end: &TrafficEnd| {
        let gncl = end.report.as_ref().and_then(|report| report.gncl.clone());
        format!("{} of {}", gncl.unwrap_or_else(|| "the port".to_owned()), end.node_label())
    };
    format!(
        "let UDP through at {} and {} in every firewall on the way (`sudo nft list ruleset`), as TCP is; or `datagrams = false` under [gncl]: then \
         one lost packet can hold values up for 200 ms",
        port(to),
        port(from)
    )
}
