//! Pressing the stop of the whole system.

use std::{sync::Arc, time::Duration};

use super::{Reply, SendError, Sender};
use crate::{
    protection::StopLatch,
    stop::{AcknowledgeStop, PressStop, StopReport},
    tid::{AppAddress, Tid},
};

/// Time beyond the wait for confirmations in which the own node answers.
const ANSWER_MARGIN: Duration = Duration::from_millis(500);
/// Longest wait for confirmations. A node waits no longer either.
const WITHIN_MAX: Duration = Duration::from_secs(60);

impl Sender {
    /// Returns the latch that the outputs of this application obey.
    pub(crate) fn stop(&self) -> &Arc<StopLatch> {
        self.shared.router.stop()
    }

    /// Returns whether outputs of this application are measured by a dry run.
    pub(crate) fn runs_dry(&self) -> bool {
        self.shared.router.runs_dry()
    }

    /// Adds this application to those with an output in this process.
    pub(crate) fn add_guarded_here(&self) {
        self.shared.router.add_guarded_here(self.shared.tid.app);
    }

    /// Acknowledges a stop that is released, for the outputs of an application in a process of its own
    /// ([`own_process`](crate::app::AppSpec::own_process)): before that they cannot be armed. In the node's process
    /// each output is acknowledged by itself, by
    /// [`Guard::acknowledge_stop`](crate::protection::Guard::acknowledge_stop), and this does nothing.
    ///
    /// Send it on the order of a person, as described there. While a stop is in force it is rejected.
    ///
    /// # Errors
    /// No queue and no socket accepted the message.
    pub fn acknowledge_stop(&self) -> Result<(), SendError> {
        self.send(Tid::new(self.shared.router.node(), AppAddress::STOP), &AcknowledgeStop {})
    }

    /// Presses the stop of the whole system: every guarded output of every node becomes safe, and stays so until an
    /// operator has released the stop, the application has acknowledged it
    /// ([`Guard::acknowledge_stop`](crate::protection::Guard::acknowledge_stop)), and has armed the output again.
    ///
    /// The outputs in this process become safe at once, without a message. The reply comes when all nodes have
    /// confirmed, and `within` this time at the latest, at most 60 s. It names the nodes that have not. It is no safety
    /// function.
    ///
    /// # Errors
    /// This node did not accept the order: its outputs in this process are stopped, and it tells the others within
    /// 100 ms. In a process of its own nothing has happened.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::{message::SendError, prelude::*};
    ///
    /// struct Gait;
    /// # impl Actor for Gait { type Context = AppContext<Self>; }
    ///
    /// fn fall(gait: &Gait, ctx: &mut AppContext<Gait>) -> Result<(), SendError> {
    ///     let reply = ctx.press_stop("the person falls", Duration::from_millis(100))?;
    ///     ctx.spawn(reply.into_actor(gait).map(|report, _, _| match report {
    ///         Ok(report) if report.is_confirmed() => println!("all outputs are safe"),
    ///         Ok(report) => eprintln!("not all have confirmed: {:?}", report.nodes),
    ///         Err(error) => eprintln!("{error}"),
    ///     }));
    ///     Ok(())
    /// }
    /// ```
    pub fn press_stop(&self, reason: &str, within: Duration) -> Result<Reply<StopReport>, SendError> {
        self.shared.router.press_stop();
        let within = within.min(WITHIN_MAX);
        let within_ms = u32::try_from(within.as_millis()).unwrap_or(u32::MAX);
        let order = PressStop { reason: reason.to_owned(), within_ms };
        let stop = Tid::new(self.shared.router.node(), AppAddress::STOP);
        self.message(stop, &order).ask(within + ANSWER_MARGIN)
    }
}
