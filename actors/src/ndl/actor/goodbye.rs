//! Sends `NDL_LEAVE` for a node whose layers have given up, since its NDL actor no longer runs.

use sinew_runtime::time::Time;

use super::{Leave, encode, lock};
use crate::{
    ndl::{
        core::{Input, Output},
        datagram::{Body, Datagram},
    },
    stores::{self, Stores},
};

/// Sends `NDL_LEAVE` to each member, with the reason for which the node gave up. Never waits for the network. // spec: NDL-4.8
pub(crate) fn say_goodbye(stores: &Stores) {
    let (announcement, leaves) = {
        let mut core = lock(stores);
        core.handle(Time::now(), Input::Stopping);
        let mut leaves = Vec::new();
        while let Some(output) = core.poll() {
            // Nobody is left for its other orders.
            if let Output::SendLeave { to, node } = output {
                leaves.push((to, node));
            }
        }
        (core.announcement().clone(), leaves)
    };
    let gave_up = stores.gave_up.get().cloned();
    let body = Body::Leave(Leave { announcement, gave_up });
    let sockets = stores::lock(&stores.ndl_sockets);
    for (to, node) in leaves {
        let datagram = Datagram { correlation: 0, sent: Time::now(), body: body.clone() };
        let mut bytes = encode(&datagram, node);
        if let Some(secured) = stores.secured.get() {
            secured.seal(&mut bytes);
        }
        if let Err(error) = sockets.send(to.here, &bytes, to.there) {
            let what = format_args!("from {} to {}: {error}", to.here, to.there);
            stores.refusals.count(Time::now(), "NDL datagram not sent", &what);
        }
    }
}
