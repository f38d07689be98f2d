//! Reports of the messages on direct links to the node, while this application is watched or recorded. spec: LNCL-20

use std::sync::Arc;

use sinew_protocol::observed::Observed;
use sinew_runtime::{
    tid::Tid,
    wire::{Header, Kind},
};

use super::Direct;
use crate::{link::Writer, loan::Draft};

/// The reports of an observed endpoint.
pub(super) struct Observer {
    own: Tid,
    /// Messages without a report since the last one: the ring to the node had no room.
    missed: u32,
}

impl Observer {
    pub(super) const fn new(own: Tid) -> Self {
        Self { own, missed: 0 }
    }

    /// Reports a message, if there is room now.
    fn report(&mut self, observed: Observed, writer: &Writer) {
        let frame = Observed { missed: self.missed, ..observed }.frame(self.own);
        self.missed = if writer.try_write(&frame) { 0 } else { self.missed.saturating_add(1) };
    }
}

impl Direct {
    #[cfg(test)]
    pub(crate) const fn is_observed(&self) -> bool {
        self.observer.is_some()
    }

    /// Returns the report of a message that is about to be sent on a link, if the endpoint is observed.
    #[inline]
    pub(crate) fn report_of(&self, draft: &Draft) -> Option<Observed> {
        self.observer.as_ref().map(|_| Observed::of(&draft.header, draft.payload.bytes(), true))
    }

    /// Reports a message that was sent.
    #[inline]
    pub(crate) fn report_sent(&mut self, report: Option<Observed>, writer: &Arc<Writer>) {
        if let (Some(observer), Some(report)) = (&mut self.observer, report) {
            observer.report(report, writer);
        }
    }

    /// Reports a message or an outcome that was received, if the endpoint is observed.
    #[inline]
    pub(crate) fn report_received(&mut self, header: &Header, payload: &[u8], writer: &Arc<Writer>) {
        let is_reported = header.kind.is_user() || header.kind == Kind::OUTCOME;
        if let Some(observer) = self.observer.as_mut().filter(|_| is_reported) {
            observer.report(Observed::of(header, payload, false), writer);
        }
    }
}
