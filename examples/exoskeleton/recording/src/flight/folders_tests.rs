//! Tests of the folders.

use super::*;

#[test]
fn journals_of_two_runs_are_apart_and_removed() {
    let run = std::env::temp_dir().join(format!("exo-flight-{}", std::process::id()));
    let [first, second] = ["first", "second"].map(|name| run.join(name));
    fs::create_dir_all(&first).unwrap();
    fs::create_dir_all(&second).unwrap();
    // given
    let (one, other) = (FlightFolders::create(&first).unwrap(), FlightFolders::create(&second).unwrap());
    let (one_folder, other_folder) = (one.journals().to_owned(), other.journals().to_owned());
    assert_ne!(one_folder, other_folder);
    assert!(one_folder.is_dir() && one.frozen().is_dir());
    // when: a killed node has left its journal
    fs::create_dir(one_folder.join("knee")).unwrap();
    fs::write(one_folder.join("knee/sinew-leg-127.0.0.3.journal"), "cut off").unwrap();
    assert_eq!(one.gather(), Frozen::default(), "it is no journal");
    drop(one);
    // then
    assert!(!one_folder.exists() && other_folder.is_dir());
    assert!(!first.join("frozen").exists(), "it has no span");
    drop(other);
    fs::remove_dir_all(run).unwrap();
}
