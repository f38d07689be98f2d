//! The fuzz target for access lists. Any text is either a list within its bounds or a set of faults. The index gives
//! the same decisions as a search through the rules.

use std::sync::Arc;

use sinew_runtime::{
    tid::{AppAddress, NodeAddress, Tid},
    wire::Class,
};

use super::{
    client::{Applicant, CLIENTS_MAX},
    file::parse,
    index::{self, Index},
    rule::{Action, List, Names, PATTERNS_MAX, Question, RULES_MAX, Verdict},
};

/// Longer texts only repeat the same cases.
const TEXT_MAX: usize = 16 * 1024;
const HERE: NodeAddress = NodeAddress::new(0x0a00_0002);
const THERE: NodeAddress = NodeAddress::new(0x0a00_0004);
/// User of the node.
const OWN: u32 = 1_000;

/// Senders and receivers, with their names in the directory.
const APPS: [(Tid, Option<&str>); 5] = [
    (Tid::new(HERE, AppAddress::new(0x1002)), Some("drive")),
    (Tid::new(HERE, AppAddress::new(0x1003)), None),
    (Tid::new(THERE, AppAddress::new(0x1001)), Some("leg.gait")),
    (Tid::new(THERE, AppAddress::new(0x2001)), Some("guest.1")),
    (Tid::new(THERE, AppAddress::new(0x8000_0000)), None),
];

pub fn some_lists() -> Vec<Vec<u8>> {
    let texts = [
        "[[rule]]\nname = 'gait'\nfrom = ['leg.*', 'gait@10.0.0.4']\nto = ['drive', '10.0.0.2/1003']\nclasses = ['control', 'stream']\n",
        "[[rule]]\nname = 'no guests'\naction = 'refuse'\nfrom = ['guest.*@10.0.0.4']\nto = ['*']\n\
         [[rule]]\nfrom = ['*/1000-20ff', 'here', '10.0.0.4']\nto = ['*']\ngroups = ['drives']\n",
        "[[client]]\nuid = 1001\nnames = ['guest.*']\naddresses = ['2000-20ff']\n[[client]]\ngid = 50\n\
         [[client]]\nuid = 0\ngid = 0x10\nnames = ['*']\naddresses = ['*']\n",
    ];
    texts.map(|text| text.as_bytes().to_vec()).into()
}

pub fn access(bytes: &[u8]) -> bool {
    let Some(text) = std::str::from_utf8(bytes).ok().filter(|text| text.len() <= TEXT_MAX) else {
        return false;
    };
    let list = match parse(text) {
        Ok(list) => Arc::new(list),
        Err(faults) => {
            assert!(!faults.to_string().is_empty(), "a refusal has words");
            return false;
        }
    };
    let patterns: usize = list.rules.iter().map(|rule| rule.from.len() + rule.to.len()).sum();
    assert!(list.rules.len() <= RULES_MAX && patterns <= PATTERNS_MAX && list.clients.len() <= CLIENTS_MAX);
    judge_messages(&list);
    judge_users(&list);
    true
}

fn judge_messages(list: &Arc<List>) {
    let index = named(&Index::new(list.clone(), HERE));
    // The list is replaced by an equal one.
    let again = index.with_list(list.clone());
    for (source, from) in APPS {
        for (target, to) in APPS.into_iter().filter(|(target, _)| target.node == HERE) {
            for class in [Class::Control, Class::Stream, Class::Bulk] {
                for group in [None, Some(AppAddress::group("drives"))] {
                    let asked = Question { source, target, group, class };
                    let verdict = list.decide(HERE, asked, Names { source: from, target: to });
                    assert_eq!((index.decide(asked), again.decide(asked)), (verdict, verdict), "{asked:?}");
                    check(list, verdict);
                }
            }
        }
    }
}

fn check(list: &List, verdict: Verdict) {
    let (rule, action) = match verdict {
        Verdict::Allowed(rule) => (Some(rule), Action::Allow),
        Verdict::Refused(rule) => (rule, Action::Refuse),
    };
    assert!(rule.is_none_or(|rule| list.rules[rule].action == action), "{verdict:?}");
    assert!(!list.describe(rule).is_empty());
}

fn named(index: &Index) -> Index {
    [HERE, THERE].into_iter().fold(index.clone(), |index, node| {
        let apps = APPS.into_iter().filter(|(tid, _)| tid.node == node);
        let apps = apps.filter_map(|(tid, name)| Some((tid.app, name?)));
        let apps = index.match_all(node, apps, &index::Named::default());
        index.with_names(node, index::Names { is_reported: true, apps, ..index::Names::default() })
    })
}

fn judge_users(list: &List) {
    for uid in [0, OWN, 1_001, u32::MAX] {
        for gid in [0, 50, OWN] {
            let applicant = Applicant { uid, gid };
            let admitted = list.admit(OWN, applicant).is_ok();
            assert_eq!(admitted, uid == OWN || uid == 0 || list.is_about(applicant), "{applicant}");
            let joins = list.may_join(OWN, applicant, AppAddress::group("drives"));
            assert!(admitted || joins.is_err(), "{applicant} may not come in, and joins a group");
            assert!(joins.err().is_none_or(|why| !why.to_string().is_empty()), "a refusal has words");
            for name in [None, Some("guest.1"), Some("gait")] {
                for address in [None, Some(AppAddress::new(0x2001))] {
                    let may = list.may_register(OWN, applicant, name, address);
                    assert!(
                        admitted || may.is_err(),
                        "{applicant} may not come in, and has {name:?} at {address:?}"
                    );
                    assert!(may.err().is_none_or(|why| !why.to_string().is_empty()), "a refusal has words");
                }
            }
        }
    }
}
