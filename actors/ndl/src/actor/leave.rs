//! Sends `NDL_LEAVE` for a node after its layers have given up, since its NDL actor no longer runs.

use sinew_runtime::{lock, time::Time};

use super::{Leave, encode, lock_core};
use crate::{
    State,
    core::{Input, Output},
    datagram::{Body, Datagram},
};

/// Sends `NDL_LEAVE` to each member, with the reason for which the node gave up. Never waits for the network.
/// // spec: NDL-4.8
pub fn send_leaves(state: &State) {
    let (announcement, leaves) = {
        let mut core = lock_core(state);
        core.handle(Time::now(), Input::Stopping);
        let mut leaves = Vec::new();
        while let Some(output) = core.poll() {
            // No receiver is left for the other outputs.
            if let Output::SendLeave { to, node } = output {
                leaves.push((to, node));
            }
        }
        (core.announcement().clone(), leaves)
    };
    let gave_up = state.ctx.gave_up.get().cloned();
    let body = Body::Leave(Leave { announcement, gave_up });
    let sockets = lock(&state.sockets);
    for (to, node) in leaves {
        let datagram = Datagram { correlation: 0, sent: Time::now(), body: body.clone() };
        let mut bytes = encode(&datagram, node);
        if let Some(secured) = state.security.secured.get() {
            secured.seal(&mut bytes);
        }
        if let Err(error) = sockets.send(to.here, &bytes, to.there) {
            let what = format_args!("from {} to {}: {error}", to.here, to.there);
            state.ctx.refusals.count(Time::now(), "NDL datagram not sent", &what);
        }
    }
}
