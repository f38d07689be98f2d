//! A client that waits until all that it requires is ready.

use std::{future::pending, io::ErrorKind, time::Duration};

use sinew_runtime::{tid::AppAddress, time::Time, wire::Kind};

use super::{
    super::{
        payload::{self, Missing, Waiting},
        reader::Reader,
        session::{Order, Session},
    },
    Client,
    end::End,
    write_now,
};
use crate::stores::{Stores, lock};

/// Time between two looks at what a client waits for.
const LOOK: Duration = Duration::from_millis(100);
/// Bytes of names and reasons that it is told at most; a client reads 64 KiB.
const TOLD_BYTES_MAX: usize = 16 * 1024;

impl Client {
    /// Holds the client until all that it requires is ready. Returns why its connection ended, if it did.
    pub(super) async fn wait_at_barrier(&self, reader: &mut Reader, session: &mut Session) -> Option<End> {
        // spec: LNCL-6
        if self.requires.is_empty() {
            return None;
        }
        // The release comes through this very thread, so that it cannot come before somebody waits for it.
        let released = self.server.wait_for_release(self.tid.app);
        let early = async {
            match reader.next(&self.peer.stream).await {
                Ok(Some(message)) => match session.handle(message) {
                    Order::Unregister => End::Unregistered,
                    Order::End(violation) => End::Refused(violation.to_string()),
                    Order::Register(_)
                    | Order::Route(_)
                    | Order::Settle { .. }
                    | Order::SetMember { .. }
                    | Order::Tell { .. }
                    | Order::Resolve { .. }
                    | Order::Introduce { .. }
                    | Order::Switch { .. }
                    | Order::RefuseMessage { .. } => End::Refused("wait for LNCL_REGISTERED".to_owned()),
                },
                Ok(None) => End::HungUp(None),
                Err(error) => End::from(error),
            }
        };
        let end = tokio::select! {
            end = early => Some(end),
            end = self.say_what_is_missing() => Some(end),
            released = released => released.is_err().then(|| End::Refused("LNCL ended".to_owned())),
        };
        self.server.forget_release(self.tid.app);
        end
    }

    /// Says what the client waits for whenever that is something else, if it wants to know. Ends with the connection.
    async fn say_what_is_missing(&self) -> End {
        if !self.waits {
            return pending().await;
        }
        let mut told = None;
        loop {
            let waiting = missing(&self.server.stores, self.tid.app);
            if told.as_ref() != Some(&waiting) {
                let lncl = payload::lncl_of(self.tid.node);
                let frame = payload::frame(Kind::LNCL_WAITING, lncl, self.tid, &waiting);
                match write_now(&self.peer.stream, &frame) {
                    Ok(()) => told = Some(waiting),
                    // It does not read: it is told later.
                    Err(End::HungUp(Some(cause))) if cause.kind() == ErrorKind::WouldBlock => {}
                    Err(end) => return end,
                }
            }
            tokio::time::sleep(LOOK).await;
        }
    }
}

/// What `app` waits for; nothing if the sync manager has not heard of it yet.
fn missing(stores: &Stores, app: AppAddress) -> Waiting {
    let mut left = TOLD_BYTES_MAX;
    let missing = lock(&stores.sync).missing(Time::now(), app).into_iter();
    let missing = missing.map(|(what, why)| Missing { what, why: why.to_owned() }).take_while(|missing| {
        let bytes = missing.what.len() + missing.why.len();
        left.checked_sub(bytes).inspect(|rest| left = *rest).is_some()
    });
    Waiting { missing: missing.collect() }
}
