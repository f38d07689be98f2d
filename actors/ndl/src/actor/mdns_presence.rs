//! Keeps the node's presence in multicast DNS.

use std::{net::SocketAddr, rc::Rc, time::Duration};

use mdns_sd::ServiceEvent;
use sinew_runtime::time::Time;

use super::{Shell, lock_core};
use crate::{
    core::{Input, Source},
    mdns::{Kept, Mdns, MdnsError},
};

/// Time between two attempts to browse mDNS again.
const BROWSE_RETRY: Duration = Duration::from_secs(1);
/// Time without mDNS after mdns-sd failed to start, used too much memory, or ended. It doubles each time up
/// to `PAUSE_MAX`, and is reset after mDNS worked for as long.
const PAUSE_MIN: Duration = Duration::from_secs(1);
const PAUSE_MAX: Duration = Duration::from_secs(600);

/// Publishes the node through mDNS and browses for others, if configured.
pub(super) async fn keep_mdns(shell: Rc<Shell>, here: SocketAddr) {
    let Some(port) = shell.state.ctx.config.ndl.mdns_port else { return };
    let mut pause = PAUSE_MIN;
    while lock_core(&shell.state).is_current(shell.epoch) {
        let begun = Time::now();
        match Mdns::start(port, here, shell.me()).await {
            Err(error) => warn_of_mdns(port, &error, pause),
            Ok(mdns) => {
                let most = Kept::most(shell.state.ctx.config.ndl.nodes_max);
                let flooded = tokio::select! {
                    () = browse(&shell, &mdns) => return,
                    () = mdns.ended() => None,
                    kept = mdns.keeps_more_than(most) => Some(kept),
                };
                if Time::now().since(begun) > PAUSE_MAX {
                    pause = PAUSE_MIN;
                }
                if let Some(kept) = flooded {
                    let what = format_args!(
                        "a host at {here} fills the memory of mDNS ({kept}; the limit is {most}): the memory is dropped, and mDNS is off for {pause:?}; \
                         multicast and seeds continue. Find the sender (`tcpdump port {port}`), or switch `ndl.mdns_port` off"
                    );
                    shell.refusals.count(Time::now(), "more records of mDNS than are kept", &what);
                } else {
                    sinew_runtime::log::warn!(
                        "mDNS at {here} has ended by itself; it restarts in {pause:?}, multicast and seeds continue"
                    );
                }
                let former = mdns.monitor();
                drop(mdns);
                // A daemon under a continuous flood ends late. There are never two daemons.
                if let Ok(former) = former {
                    while former.recv_async().await.is_ok() {}
                }
            }
        }
        tokio::time::sleep(pause).await;
        pause = PAUSE_MAX.min(pause * 2);
    }
}

async fn browse(shell: &Shell, mdns: &Mdns) {
    loop {
        match mdns.browse() {
            Ok(events) => {
                while let Ok(event) = events.recv_async().await {
                    if !resolved(shell, mdns, &event) {
                        return;
                    }
                }
                // mdns-sd drops a listener that is a thousand events behind.
                sinew_runtime::log::warn!("NDL missed events of mDNS; listening again");
            }
            Err(error) => {
                sinew_runtime::log::warn!("NDL cannot browse mDNS for nodes: {error}; it retries")
            }
        }
        tokio::time::sleep(BROWSE_RETRY).await;
    }
}

fn resolved(shell: &Shell, mdns: &Mdns, event: &ServiceEvent) -> bool {
    // Its other events are about mdns-sd itself, or about removed records, which do not concern liveness.
    let ServiceEvent::ServiceResolved(service) = event else { return true };
    let addresses = mdns.addresses(service);
    addresses.into_iter().all(|address| {
        shell.feed(|core, now| core.handle(now, Input::AddressNamed { source: Source::Mdns, address }))
    })
}

fn warn_of_mdns(port: u16, error: &MdnsError, pause: Duration) {
    sinew_runtime::log::warn!(
        "NDL does not use mDNS on port {port}: {error}; it is tried again in {pause:?}, and until then nodes are found through multicast and seeds only. Set \
         `ndl.mdns_port` to a port that this process may share, or switch it off"
    );
}
