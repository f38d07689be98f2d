//! The index and a search give the same verdict on any message. Any text is a list or a set of faults.

use proptest::prelude::*;

use super::*;
use crate::access::{
    index::{self, Index},
    rule::List,
};

fn indexed(index: &Index, names: &BTreeMap<Tid, Arc<str>>) -> Index {
    [HERE, THERE, NodeAddress::new(9)].into_iter().fold(index.clone(), |index, node| {
        let on_it = names.iter().filter(|(tid, _)| tid.node == node);
        let before = index.names_on(node);
        let apps = index.match_all(node, on_it.map(|(tid, name)| (tid.app, &**name)), &before.apps);
        index.with_names(node, index::Names { is_reported: true, apps, ..before })
    })
}

fn who() -> impl Strategy<Value = String> {
    prop::sample::select(vec![
        "*",
        "10.0.0.4",
        "here",
        "*/1000",
        "*/1000-1001",
        "here/1001",
        "10.0.0.4/1000",
        "a",
        "a*",
        "b@here",
        "*@10.0.0.4",
        "*b",
    ])
    .prop_map(|text| format!("'{text}'"))
}

fn rule() -> impl Strategy<Value = String> {
    let list = |each| prop::collection::vec(each, 1..3).prop_map(|texts| texts.join(", "));
    let classes = prop::sample::select(vec!["'control'", "'stream', 'bulk'", "'control', 'stream', 'bulk'"]);
    let group = prop::sample::select(vec!["", "groups = ['g']\n", "groups = ['g', 'h']\n"]);
    let action = prop::sample::select(vec!["allow", "refuse"]);
    (list(who().boxed()), list(who().boxed()), classes, group, action).prop_map(
        |(from, to, classes, group, action)| {
            format!(
                "[[rule]]\nfrom = [{from}]\nto = [{to}]\n{group}classes = [{classes}]\naction = '{action}'\n"
            )
        },
    )
}

fn tid() -> impl Strategy<Value = Tid> {
    let apps = [0x1000, 0x1001, 0x1002, 0x8000_0000];
    (prop::sample::select(vec![HERE, THERE, NodeAddress::new(9)]), prop::sample::select(apps.to_vec()))
        .prop_map(|(node, number)| app(node, number))
}

fn names() -> impl Strategy<Value = BTreeMap<Tid, Arc<str>>> {
    let name = prop::sample::select(vec!["a", "b", "ab"]).prop_map(Arc::from);
    prop::collection::btree_map(tid(), name, 0..6)
}

fn question() -> impl Strategy<Value = Question> {
    let group = prop::option::of(prop::sample::select(vec!["g", "h", "i"]).prop_map(AppAddress::group));
    let target = prop::sample::select(vec![0x1000, 0x1001, 0x1002]).prop_map(|number| app(HERE, number));
    (tid(), target, group, prop::sample::select(Class::ALL.to_vec()))
        .prop_map(|(source, target, group, class)| Question { source, target, group, class })
}

proptest! {
    #[test]
    fn index_and_search_agree_for_any_known_names(
        rules in prop::collection::vec(rule(), 0..80), before in names(), now in names(),
        questions in prop::collection::vec(question(), 1..20),
    ) {
        let list: Arc<List> = Arc::new(parse(&rules.concat()).expect("it is written as lists are"));
        let index = indexed(&indexed(&Index::new(list.clone(), HERE), &before), &now);
        for asked in questions {
            let name = |tid| now.get(&tid).map(|name| &**name);
            let names = Names { source: name(asked.source), target: name(asked.target) };
            prop_assert_eq!(index.decide(asked), list.decide(HERE, asked, names), "{:?}", asked);
        }
    }

    #[test]
    fn appended_rule_allows_nothing_refused_before(
        rules in prop::collection::vec(rule(), 0..6), last in rule(), names in names(), asked in question(),
    ) {
        let decide = |text: &str| indexed(&Index::new(Arc::new(parse(text).unwrap()), HERE), &names).decide(asked);
        let (before, after) = (decide(&rules.concat()), decide(&(rules.concat() + &last)));
        prop_assert!(before == after || before == Verdict::Refused(None), "{:?} {:?}", before, after);
    }

    #[test]
    fn any_text_is_a_list_or_faults(text in ".{0,200}") {
        let _ = parse(&text);
    }

    #[test]
    fn damaged_list_is_a_list_or_faults(rules in prop::collection::vec(rule(), 1..4), at: prop::sample::Index, with: char) {
        let mut text: Vec<char> = (rules.concat() + POLICY).chars().collect();
        let at = at.index(text.len());
        text[at] = with;
        let _ = parse(&text.into_iter().collect::<String>());
    }
}
