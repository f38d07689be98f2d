#compdef sinew-node
_arguments '(- :)'{-h,--help}'[Print help]' '(- :)'{-V,--version}'[Print version]' '1:configuration:_files -g "*.toml"'
