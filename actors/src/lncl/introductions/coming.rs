//! Those whose rings are being made, and who has asked for them meanwhile: they are introduced when that is done.

use std::{cell::RefCell, collections::BTreeMap, sync::Arc};

use sinew_runtime::{outcome::Rejection, tid::Tid, time::Time};

use super::{
    Introductions, Party, Question, tell_refused,
    unanswered::{Processes, Unanswered},
};

/// Who asks for one that cannot be met yet.
pub(super) struct Asked {
    pub(super) asker: Arc<Party>,
    pub(super) to: Tid,
    pub(super) question: Question,
}

/// All of them.
#[derive(Default)]
pub(super) struct Coming {
    /// With the process of each, as the kernel says.
    expected: RefCell<BTreeMap<Tid, u32>>,
    /// As bounded as those that wait for an answer, though they cost no descriptors.
    asked: RefCell<Unanswered<Asked>>,
}

impl Introductions {
    /// `tid`, of the process `pid`, can be met soon: who asks for it until then waits for that.
    pub(in crate::lncl) fn expect(&self, tid: Tid, pid: u32) {
        self.coming.expected.borrow_mut().insert(tid, pid);
    }

    /// `tid` will have no links.
    pub(in crate::lncl) fn expect_no_more(&self, tid: Tid) {
        self.coming.no_more(tid);
    }
}

impl Coming {
    pub(super) fn is_expected(&self, tid: Tid) -> bool {
        self.expected.borrow().contains_key(&tid)
    }

    /// Keeps a question until the one it is about can be met.
    ///
    /// # Errors
    /// [`Rejection::QueueFull`]: so many wait, of all or of one process.
    pub(super) fn wait(&self, asked: Asked, now: Time) -> Result<(), Rejection> {
        let peer = self.expected.borrow().get(&asked.to).copied().unwrap_or_default();
        let of = Processes { asker: asked.asker.pid, peer };
        let mut waiting = self.asked.borrow_mut();
        if !waiting.has_room_for(of) {
            return Err(Rejection::QueueFull);
        }
        waiting.insert(asked.question.number, of, asked, now);
        Ok(())
    }

    /// `tid` can be met: those who have asked for it, and since when.
    pub(super) fn arrived(&self, tid: Tid) -> Vec<(Asked, Time)> {
        self.expected.borrow_mut().remove(&tid);
        self.asked.borrow_mut().remove_if(|asked| asked.to == tid)
    }

    /// `tid` will have no links: those who have asked for it are told.
    fn no_more(&self, tid: Tid) {
        for (Asked { asker, to, question }, _) in self.arrived(tid) {
            tell_refused(&asker, to, question, Rejection::Unsupported);
        }
    }

    /// `tid` is not there any more: what it has asked for is forgotten, and who has asked for it is told.
    pub(super) fn gone(&self, tid: Tid) {
        drop(self.asked.borrow_mut().remove_if(|asked| asked.asker.tid == tid));
        self.no_more(tid);
    }

    /// Tells those who have waited too long at `now` that it is not to be now.
    pub(super) fn give_up(&self, now: Time) {
        let late = self.asked.borrow_mut().give_up(now);
        for Asked { asker, to, question } in late {
            tell_refused(&asker, to, question, Rejection::QueueFull);
        }
    }
}
