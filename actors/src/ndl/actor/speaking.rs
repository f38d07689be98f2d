//! Keeps the node's presence in multicast DNS.

use std::{net::SocketAddr, rc::Rc, time::Duration};

use futures_util::future::join;
use mdns_sd::{DaemonEvent, ServiceEvent};
use sinew_runtime::time::Time;

use super::{Shell, lock};
use crate::{
    ndl::{
        core::{Input, Source},
        mdns::{Kept, Mdns, MdnsError},
    },
    refusals::Refusals,
};

/// Time between two attempts to listen to mDNS again.
const REST: Duration = Duration::from_secs(1);
/// Time without mDNS after mdns-sd kept too much. It doubles each time, up to the second, and begins anew when all was well for as long.
const PAUSE_MIN: Duration = Duration::from_secs(1);
const PAUSE_MAX: Duration = Duration::from_secs(600);

/// Publishes the node there and looks for others, if the configuration says so.
pub(super) async fn speak_mdns(shell: Rc<Shell>, here: SocketAddr) {
    let Some(port) = shell.stores.config.ndl.mdns_port else { return };
    let (mut pause, mut has_spoken) = (PAUSE_MIN, false);
    while lock(&shell.stores).is_current(shell.epoch) {
        let begun = Time::now();
        let mdns = match Mdns::start(port, here, shell.me()).await {
            Ok(mdns) => mdns,
            Err(error) if has_spoken => {
                crate::log::warn!(
                    "NDL does not get mDNS back on port {port}: {error}; it is tried again in {pause:?}"
                );
                tokio::time::sleep(pause).await;
                pause = PAUSE_MAX.min(pause * 2);
                continue;
            }
            Err(error) => return warn_of_mdns(port, &error),
        };
        has_spoken = true;
        let most = Kept::most(shell.stores.config.ndl.nodes_max);
        let kept = tokio::select! {
            ((), ()) = join(watch_mdns(&mdns), browse(&shell, &mdns)) => return,
            kept = mdns.keeps_more_than(most) => kept,
        };
        if Time::now().since(begun) > PAUSE_MAX {
            pause = PAUSE_MIN;
        }
        let what = format_args!(
            "somebody at {here} fills the memory of mDNS ({kept}, and {most} is the limit): it is forgotten, and there is no mDNS for {pause:?}; \
             multicast and seeds go on. See who sends that (`tcpdump port {port}`), or switch `ndl.mdns_port` off"
        );
        shell.refusals.count(Time::now(), "more records of mDNS than are kept", &what);
        let former = mdns.monitor();
        drop(mdns);
        tokio::time::sleep(pause).await;
        pause = PAUSE_MAX.min(pause * 2);
        // Flooded without a pause it hears of its end late: there are never two.
        if let Ok(former) = former {
            while former.recv_async().await.is_ok() {}
        }
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

/// mdns-sd binds its socket in its own thread and reports what fails there.
async fn watch_mdns(mdns: &Mdns) {
    let Ok(events) = mdns.monitor() else { return };
    let failures = Refusals::default();
    while let Ok(event) = events.recv_async().await {
        if let DaemonEvent::Error(error) = event {
            failures.count(Time::now(), "mDNS reports a fault", &error);
        }
    }
}

fn warn_of_mdns(port: u16, error: &MdnsError) {
    crate::log::warn!(
        "NDL does not use mDNS on port {port}: {error}; nodes are found through multicast and seeds only. Set \
         `ndl.mdns_port` to a port that this process may share, or switch it off"
    );
}
