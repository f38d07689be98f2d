//! Declarations of contracts, legal ones and others.

use actix::Actor;

use super::*;
use crate::app::{AppContext, AppSpec, DynApp};

const MS: Duration = Duration::from_millis(1);

fn of_gait() -> Contract {
    Contract::when_lost("gait").or_late(10 * MS).or_stopped().goes_to("damped", 100 * MS)
}

#[test]
fn contract_lists_its_conditions_in_order() {
    let conditions: Vec<_> = of_gait().conditions().collect();
    assert_eq!(conditions, [Condition::Lost, Condition::Late(10 * MS), Condition::Stopped]);
    let stopped = Contract::when_stopped("gait").goes_to("damped", MS);
    assert_eq!(stopped.conditions().collect::<Vec<_>>(), [Condition::Stopped]);
}

#[test]
fn legal_contracts_have_no_fault() {
    let of_node = Contract::when_lost(Subject::node("central")).goes_to("damped", CONTRACT_TIME_MAX);
    let of_panel = Contract::when_lost("panel").goes_to("damped", MS).through("gait");
    assert_eq!(fault("knee", &[of_gait(), of_node, of_panel]), None);
    assert_eq!(fault("knee", &[]), None);
}

struct Knee;

impl Actor for Knee {
    type Context = AppContext<Self>;
}

#[test]
fn illegal_contract_is_a_fault_of_its_application() {
    let knee = |contract| DynApp::from(AppSpec::new("knee", || Knee).contract(contract));
    let legal = knee(of_gait());
    assert_eq!((legal.fault(), legal.contracts()), (None, &[of_gait()][..]));
    let of_itself = knee(Contract::when_stopped("knee").goes_to("damped", MS));
    assert!(of_itself.fault().is_some_and(|why| why.contains("the application itself")));
}

#[test]
fn each_illegal_declaration_is_named() {
    let late = |time| Contract::when_late("gait", time).goes_to("damped", MS);
    let cases = [
        (vec![of_gait(); 2], "two of its contracts are about 'gait' being lost"),
        (vec![Contract::when_lost("knee").goes_to("damped", MS)], "names the application itself"),
        (
            vec![Contract::when_lost("hip").goes_to("damped", MS).through("knee")],
            "names the application itself",
        ),
        (vec![Contract::when_lost("").goes_to("damped", MS)], "no valid name"),
        (vec![Contract::when_lost("gait").goes_to("", MS)], "the state ''"),
        (vec![Contract::when_lost("gait").goes_to("damped", Duration::ZERO)], "more than 0"),
        (vec![late(Duration::ZERO)], "more than 0"),
        (vec![late(CONTRACT_TIME_MAX + MS)], "at most 60s"),
        (vec![Contract::when_lost("hip").goes_to("damped", MS).through("*")], "`through`"),
        (vec![of_gait(); CONTRACTS_MAX + 1], "33 contracts are more than the 32"),
    ];
    for (contracts, words) in cases {
        let found = fault("knee", &contracts);
        assert!(found.as_ref().is_some_and(|found| found.contains(words)), "{words}: {found:?}");
    }
}
