//! What other layers ask LNCL.

use std::fmt::Display;

use sinew_model::{ports::Applications, undelivered::Report};
use sinew_runtime::{
    lock,
    tid::{AppAddress, NodeAddress},
    time::Time,
};

use super::{State, undelivered};

impl Applications for State {
    fn title_of(&self, app: AppAddress) -> String {
        lock(&self.registry).name_of(app)
    }

    fn resolve(&self, name: &str) -> Option<AppAddress> {
        lock(&self.registry).resolve(name)
    }

    fn observe_links(&self) {
        if self.observed_links.observe(&self.ctx.router) {
            self.ctx.checks.request();
        }
    }

    fn undelivered_elsewhere(&self, node: NodeAddress, report: Report, refuse: &mut dyn FnMut(&dyn Display)) {
        undelivered::note(self, (node, report), Time::now(), refuse);
    }
}
