//! Which way values of class Stream go: by UDP, or by the connection, and why.

use sinew::inspect::StreamReport;

use super::{End, Steps, keys::has_keys};

impl Steps {
    /// Which way they go from `from` to `to`. `after` is what was counted when one had just been sent.
    pub(super) fn streamed(&mut self, from: &End, to: &End, after: Option<&StreamReport>) {
        let peer = to.node.and_then(|node| from.peer(node));
        // Where there is no connection nothing goes any way.
        let Some(peer) =
            peer.filter(|peer| !peer.links.is_empty() && peer.links.iter().all(|link| link.is_up))
        else {
            return;
        };
        let what = format!("class Stream from {} to {}", from.label(), to.label());
        let Some(before) = &peer.stream else { return };
        // Before the others: between these no setting lets datagrams through, so none is named.
        if !before.is_agreed && both_have_keys(from, to) {
            return self.fine(what, "by the connection (TCP), as nodes with keys do");
        }
        if !before.is_on {
            let mend =
                format!("`datagrams = true` under [gncl] of {}, where UDP gets through", from.node_label());
            return self.note(what, "by the connection (TCP): datagrams are switched off here", mend);
        }
        if !before.is_agreed {
            let mend = format!(
                "`datagrams = true` under [gncl] of {}; if it is so, its version knows none",
                to.node_label()
            );
            return self.note(what, "by the connection (TCP): the other end takes no datagrams", mend);
        }
        if let Some(payload_max) = after.unwrap_or(before).payload_max {
            let seen = format!(
                "values of up to {payload_max} bytes by datagram (UDP), longer ones by the connection (TCP): longer datagrams do not arrive"
            );
            return self.note(what, seen, long_packets(from, to));
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

/// Whether both have keys. One that does not say has them if the other one has: they are connected, and those with and without refuse each other.
fn both_have_keys(from: &End, to: &End) -> bool {
    let said = |end: &End| end.report.as_ref().and_then(has_keys);
    match (said(from), said(to)) {
        (Some(one), Some(other)) => one && other,
        (Some(either), None) | (None, Some(either)) => either,
        (None, None) => false,
    }
}

/// What lets long packets through.
fn long_packets(from: &End, to: &End) -> String {
    format!(
        "give the interfaces of {}, of {} and of all between them one MTU (`ip link` shows it, `sudo ip link set eth0 mtu 1500` sets it), and let ICMP \
         \"packet too big\" through every firewall",
        from.node_label(),
        to.node_label()
    )
}

/// What lets datagrams through.
fn blocked(from: &End, to: &End) -> String {
    // A node reads them at the port of its connections, if that is free.
    let port = |end: &End| {
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
