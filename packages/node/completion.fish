complete -c sinew-node -s h -l help -d 'Print help'
complete -c sinew-node -s V -l version -d 'Print version'
complete -c sinew-node -k -xa '(__fish_complete_suffix .toml)'
