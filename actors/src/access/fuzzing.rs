//! Any text as an access list, against what is promised: it is a list within its bounds or faults in words, and the table that messages
//! are judged by says the same as a search through its rules.

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

/// Longer texts are the same again and again.
const TEXT_MAX: usize = 16 * 1024;
const HERE: NodeAddress = NodeAddress::new(0x0a00_0002);
const THERE: NodeAddress = NodeAddress::new(0x0a00_0004);
/// The user that the node runs as.
const OWN: u32 = 1_000;

/// Who sends and who gets, with what the directory calls them.
const APPS: [(Tid, Option<&str>); 5] = [
    (Tid::new(HERE, AppAddress::new(0x1002)), Some("drive")),
    (Tid::new(HERE, AppAddress::new(0x1003)), None),
    (Tid::new(THERE, AppAddress::new(0x1001)), Some("leg.gait")),
    (Tid::new(THERE, AppAddress::new(0x2001)), Some("guest.1")),
    (Tid::new(THERE, AppAddress::new(0x8000_0000)), None),
];

pub(crate) fn some_lists() -> Vec<Vec<u8>> {
    let texts = [
        "[[rule]]\nname = 'gait'\nfrom = ['leg.*', 'gait@10.0.0.4']\nto = ['drive', '10.0.0.2/1003']\nclasses = ['control', 'stream']\n",
        "[[rule]]\nname = 'no guests'\naction = 'refuse'\nfrom = ['guest.*@10.0.0.4']\nto = ['*']\n\
         [[rule]]\nfrom = ['*/1000-20ff', 'here', '10.0.0.4']\nto = ['*']\ngroups = ['drives']\n",
        "[[client]]\nuid = 1001\nnames = ['guest.*']\naddresses = ['2000-20ff']\n[[client]]\ngid = 50\n\
         [[client]]\nuid = 0\ngid = 0x10\nnames = ['*']\naddresses = ['*']\n",
    ];
    texts.map(|text| text.as_bytes().to_vec()).into()
}

pub(crate) fn access(bytes: &[u8]) -> bool {
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
    // The file was read again, and nothing of it changed.
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
    assert!(!list.in_words(rule).is_empty());
}

fn named(index: &Index) -> Index {
    [HERE, THERE].into_iter().fold(index.clone(), |index, node| {
        let apps = APPS.into_iter().filter(|(tid, _)| tid.node == node);
        let apps = apps.filter_map(|(tid, name)| Some((tid.app, name?)));
        let apps = index.look_all(node, apps, &index::Named::default());
        index.with_names(node, index::Names { is_told: true, apps, ..index::Names::default() })
    })
}

fn judge_users(list: &List) {
    for uid in [0, OWN, 1_001, u32::MAX] {
        for gid in [0, 50, OWN] {
            let who = Applicant { uid, gid };
            let admitted = list.admit(OWN, who).is_ok();
            assert_eq!(admitted, uid == OWN || uid == 0 || list.is_about(who), "{who}");
            let joins = list.may_join(OWN, who, AppAddress::group("drives"));
            assert!(admitted || joins.is_err(), "{who} may not come in, and joins a group");
            assert!(joins.err().is_none_or(|why| !why.to_string().is_empty()), "a refusal has words");
            for name in [None, Some("guest.1"), Some("gait")] {
                for address in [None, Some(AppAddress::new(0x2001))] {
                    let may = list.may_register(OWN, who, name, address);
                    assert!(
                        admitted || may.is_err(),
                        "{who} may not come in, and has {name:?} at {address:?}"
                    );
                    assert!(may.err().is_none_or(|why| !why.to_string().is_empty()), "a refusal has words");
                }
            }
        }
    }
}
