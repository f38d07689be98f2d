//! Keeps the node's presence in multicast DNS.

use std::{net::SocketAddr, rc::Rc, time::Duration};

use mdns_sd::ServiceEvent;
use sinew_runtime::time::Time;

use super::{Shell, lock};
use crate::ndl::{
    core::{Input, Source},
    mdns::{Kept, Mdns, MdnsError},
};

/// Time between two attempts to listen to mDNS again.
const REST: Duration = Duration::from_secs(1);
/// Time without mDNS after mdns-sd could not begin, kept too much, or has ended. It doubles each time, up to the second, and begins anew when all was well for as long.
const PAUSE_MIN: Duration = Duration::from_secs(1);
const PAUSE_MAX: Duration = Duration::from_secs(600);

/// Publishes the node there and looks for others, if the configuration says so.
pub(super) async fn speak_mdns(shell: Rc<Shell>, here: SocketAddr) {
    let Some(port) = shell.stores.config.ndl.mdns_port else { return };
    let mut pause = PAUSE_MIN;
    while lock(&shell.stores).is_current(shell.epoch) {
        let begun = Time::now();
        match Mdns::start(port, here, shell.me()).await {
            Err(error) => warn_of_mdns(port, &error, pause),
            Ok(mdns) => {
                let most = Kept::most(shell.stores.config.ndl.nodes_max);
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
                        "somebody at {here} fills the memory of mDNS ({kept}, and {most} is the limit): it is forgotten, and there is no mDNS for {pause:?}; \
                         multicast and seeds go on. See who sends that (`tcpdump port {port}`), or switch `ndl.mdns_port` off"
                    );
                    shell.refusals.count(Time::now(), "more records of mDNS than are kept", &what);
                } else {
                    crate::log::warn!(
                        "mDNS at {here} has ended by itself; it begins anew in {pause:?}, multicast and seeds go on"
                    );
                }
                let former = mdns.monitor();
                drop(mdns);
                // Flooded without a pause it hears of its end late: there are never two.
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
                crate::log::warn!("NDL missed events of mDNS; listening again");
            }
            Err(error) => crate::log::warn!("NDL cannot look for nodes through mDNS: {error}; trying again"),
        }
        tokio::time::sleep(REST).await;
    }
}

fn resolved(shell: &Shell, mdns: &Mdns, event: &ServiceEvent) -> bool {
    // Its other events say what mdns-sd is doing, or that a record is gone: liveness is not its business.
    let ServiceEvent::ServiceResolved(service) = event else { return true };
    let addresses = mdns.addresses(service);
    addresses.into_iter().all(|address| {
        shell.feed(|core, now| core.handle(now, Input::AddressNamed { source: Source::Mdns, address }))
    })
}

fn warn_of_mdns(port: u16, error: &MdnsError, pause: Duration) {
    crate::log::warn!(
        "NDL does not use mDNS on port {port}: {error}; it is tried again in {pause:?}, and until then nodes are found through multicast and seeds only. Set \
         `ndl.mdns_port` to a port that this process may share, or switch it off"
    );
}
