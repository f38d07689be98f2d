//! The questions about the access list and what answers them.

use serde::{Deserialize, Serialize};
use sinew_runtime::{tid::Tid, wire::Class};

use super::Report;
use crate::{payload, sync::at_most};

/// Classes that there are.
pub(super) const CLASSES: usize = Class::ALL.len();

payload!("sinew.inspect.access" =>
    /// May this application send to that one of yours? [`AccessReport`] answers.
    #[derive(Clone, Copy, Debug)]
    pub struct AskAccess {
        /// Who would send.
        pub source: Tid,
        /// The application of the node that is asked, which would get it.
        pub target: Tid,
    }
);

payload!("sinew.inspect.access_report" =>
    /// What the access list of a node says of messages from one application to another.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::{AppAddress, Endpoint, Tid, client::ApiError, inspect::{AccessReport, AskAccess}, prelude::*};
    ///
    /// fn explain(endpoint: &mut Endpoint, source: Tid, target: Tid) -> Result<(), ApiError> {
    ///     let inspect = Tid::new(target.node, AppAddress::INSPECT);
    ///     let question = AskAccess { source, target };
    ///     let report: AccessReport = endpoint.message(inspect, &question).ask(Duration::from_secs(1))?;
    ///     report.verdicts.iter().for_each(|verdict| println!("{:?}: {}", verdict.class, verdict.why));
    ///     Ok(())
    /// }
    /// ```
    #[derive(Clone, Debug, PartialEq, Eq)]
    pub struct AccessReport {
        /// Whether the node has a list; without one everything is allowed.
        pub is_given: bool,
        /// For each class, if there is a list.
        #[serde(deserialize_with = "at_most::<_, _, CLASSES>")]
        pub verdicts: Vec<AccessVerdict>,
    }
);

/// What becomes of messages of one class.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct AccessVerdict {
    /// The class.
    pub class: Class,
    /// Whether they are let through.
    pub is_allowed: bool,
    /// Which rule says so, or that there is none, and for which names it was looked up.
    pub why: String,
}

payload!("sinew.inspect.reload" =>
    /// Read your access list and your deny list again. Only a program on the node's own host is obeyed. [`ReloadReport`] answers.
    #[derive(Clone, Copy, Debug, Default)]
    pub struct AskReload {}
);

payload!("sinew.inspect.reload_report" =>
    /// The lists that are in force now.
    #[derive(Clone, Debug, PartialEq, Eq)]
    pub struct ReloadReport {
        /// Rules of the access list for messages.
        pub rules: u64,
        /// Rules of the access list for users of the node's host.
        pub clients: u64,
        /// Whether the node has an access list: without one everything is allowed.
        #[serde(default = "has_list")]
        pub has_list: bool,
        /// How many certificates are on the deny list that is in force; `None` of a node without keys.
        #[serde(default)]
        pub denied: Option<u64>,
        /// How many of those that were on the one before are not any more: they count again.
        #[serde(default)]
        pub readmitted: u64,
        /// Why a list is the one that was in force before, or that there is none, or what else is to be done; in words, one fault a line.
        pub refused: Option<String>,
    }
);

/// Nodes from before there was that field answer so only where they have a list.
const fn has_list() -> bool {
    true
}

/// It has no list of unknown length.
impl Report for AccessReport {
    fn halve(&mut self) -> bool {
        false
    }
}

impl Report for ReloadReport {
    fn halve(&mut self) -> bool {
        let Some(words) = &mut self.refused else { return false };
        let kept: String = words.chars().take(words.chars().count() / 2).collect();
        let had_any = kept.len() < words.len();
        *words = kept;
        had_any
    }
}
