//! The command line of `sinew-node`.

#[test]
fn node_prints_help_and_version_and_rejects_unknown_options() {
    let run = |words: &[&str]| {
        let node = env!("CARGO_BIN_EXE_sinew-node");
        let output = std::process::Command::new(node).args(words).output().expect("it starts");
        let text = |bytes| String::from_utf8(bytes).expect("it writes text");
        (output.status.code(), text(output.stdout), text(output.stderr))
    };
    for help in ["--help", "-h"] {
        let (code, out, _) = run(&[help]);
        assert!(code == Some(0) && out.contains("Usage: sinew-node CONFIGURATION"), "{out}");
    }
    for version in ["--version", "-V"] {
        let (code, out, _) = run(&[version]);
        assert!(code == Some(0) && out == concat!("sinew-node ", env!("CARGO_PKG_VERSION"), "\n"), "{out}");
    }
    for (words, why) in [
        (&[][..], "the configuration of the node is missing"),
        (&["a.toml", "b.toml"], "there are 2 arguments, and one is legal"),
        (&["--verbose"], "there is no option \"--verbose\"; a file of this name is ./--verbose"),
    ] {
        let (code, out, err) = run(words);
        assert!(code == Some(2) && out.is_empty() && err.contains(why), "{err}");
        assert!(err.contains("sinew-node --help"), "{err}");
    }
    let (code, _, err) = run(&["--", "-nowhere.toml"]);
    assert!(code == Some(1) && err.contains("-nowhere.toml"), "{err}");
}
