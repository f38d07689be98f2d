//! Has the node stop on signals.

use actix::{AsyncContext as _, Context, fut::WrapFuture as _};

use super::{Root, RootEvent, post_event};
use crate::signals::StopSignals;

impl Root {
    pub(super) fn heed_signals(&mut self, context: &mut Context<Self>) {
        if std::mem::replace(&mut self.heeds_signals, true) {
            return;
        }
        let queue = self.state.root.clone();
        let mut signals = match StopSignals::listen() {
            Ok(signals) => signals,
            Err(error) => {
                sinew_runtime::log::error!(%error, remedy = "stop this node by its handle", "SIGINT, SIGTERM and SIGHUP cannot be handled and end this process at once");
                return;
            }
        };
        let heed = async move {
            let which = signals.recv().await;
            sinew_runtime::log::info!(signal = which, "a signal asks for a stop");
            post_event(&queue, RootEvent::StopOrdered);
        };
        context.spawn(heed.into_actor(self));
    }
}
