//! A client that waits until all applications that it requires are ready.

use std::{cell::Cell, future::pending, time::Duration};

use bytes::BytesMut;
use sinew_protocol::payload::{self, Missing, Waiting};
use sinew_runtime::{tid::AppAddress, wire::Kind};

use super::{
    super::{
        reader::Reader,
        session::{Order, Session},
    },
    Client,
    end::ConnectionEnd,
    writing::{encoded, write_some, write_soon},
};
use crate::State;

/// Interval of the check on the applications that a client waits for.
const CHECK_INTERVAL: Duration = Duration::from_secs(1);
/// The interval while these are unknown.
const FIRST_CHECK_INTERVAL: Duration = Duration::from_millis(100);
/// Maximum number of bytes of names and reasons in a report. Even the smallest empty socket takes this frame as a
/// whole.
const REPORT_BYTES_MAX: usize = 1_536;

impl Client {
    /// Waits until all applications that the client requires are ready. Returns the end of its connection, if that
    /// comes first.
    pub(super) async fn wait_at_barrier(
        &self,
        reader: &mut Reader,
        session: &mut Session,
    ) -> Option<ConnectionEnd> {
        // spec: LNCL-6
        if self.requires.is_empty() {
            return None;
        }
        // This thread sends the release, so it cannot precede the registration of the waiter.
        let released = self.server.wait_for_release(self.tid.app);
        let early = async {
            match reader.next(&self.peer.stream).await {
                Ok(Some(message)) => match session.handle(message) {
                    Order::Unregister => ConnectionEnd::Unregistered,
                    Order::End(violation) => ConnectionEnd::Refused(violation.to_string()),
                    Order::Register(_)
                    | Order::Route(_)
                    | Order::Settle { .. }
                    | Order::SetMember { .. }
                    | Order::RefuseMembership { .. }
                    | Order::Resolve { .. }
                    | Order::Introduce { .. }
                    | Order::Switch { .. }
                    | Order::DeclareType(_)
                    | Order::Ready
                    | Order::Observe(_)
                    | Order::RefuseMessage { .. } => {
                        ConnectionEnd::Refused("wait for LNCL_REGISTERED".to_owned())
                    }
                },
                Ok(None) => ConnectionEnd::HungUp(None),
                Err(error) => ConnectionEnd::from(error),
            }
        };
        let unsent = Cell::default();
        let end = tokio::select! {
            end = early => Some(end),
            end = self.send_missing(&unsent) => Some(end),
            released = released => released.is_err().then(|| ConnectionEnd::Refused("LNCL ended".to_owned())),
        };
        self.server.forget_release(self.tid.app);
        if end.is_some() {
            return end;
        }
        // A partly written report is completed before any other frame.
        write_soon(&self.peer.stream, unsent.into_inner()).await.err()
    }

    /// Reports the applications that the client waits for whenever they change, if it asked for that. Ends with the
    /// connection.
    async fn send_missing(&self, unsent: &Cell<BytesMut>) -> ConnectionEnd {
        if !self.waits {
            return pending().await;
        }
        let mut reported = None;
        loop {
            let mut bytes = unsent.take();
            // A client that does not read its report gets the next one later.
            if bytes.is_empty()
                && let Some(waiting) = missing(&self.server.state, self.tid.app)
                && reported.as_ref() != Some(&waiting)
            {
                let lncl = payload::lncl_of(self.tid.node);
                bytes = encoded(&payload::frame(Kind::LNCL_WAITING, lncl, self.tid, &waiting));
                reported = Some(waiting);
            }
            let wrote = write_some(&self.peer.stream, &mut bytes);
            unsent.set(bytes);
            if let Err(end) = wrote {
                return end;
            }
            let is_known = reported.as_ref().is_some_and(|reported: &Waiting| !reported.missing.is_empty());
            tokio::time::sleep(if is_known { CHECK_INTERVAL } else { FIRST_CHECK_INTERVAL }).await;
        }
    }
}

/// Returns the applications that `app` waits for. The list is empty if the sync manager does not know `app` yet.
/// Returns `None` while the sync manager is busy, since this thread does not wait for it.
fn missing(state: &State, app: AppAddress) -> Option<Waiting> {
    let missing =
        state.ctx.ports.names().map_or_else(|| Some(Vec::new()), |names| names.missing_in_brief(app))?;
    let mut left = REPORT_BYTES_MAX;
    let missing = missing.into_iter().map(|(what, why)| Missing { what, why: why.to_owned() });
    let missing = missing.take_while(|missing| {
        let bytes = missing.what.len() + missing.why.len();
        left.checked_sub(bytes).inspect(|rest| left = *rest).is_some()
    });
    Some(Waiting { missing: missing.collect() })
}
