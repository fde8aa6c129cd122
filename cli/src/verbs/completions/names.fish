
# Network interfaces, and the devices of the machine files on the line.
function __ecaxis_devices
    for word in (commandline -opc)
        string match -q '*.toml' -- $word; and test -r $word
        and string replace -rf '^ *name *= *"([^"]*)".*' '$1' <$word
    end
end
complete -c ecaxis -n "__fish_seen_subcommand_from scan doctor" -a '(__fish_print_interfaces)'
complete -c ecaxis -n "__fish_seen_subcommand_from sdo eeprom firmware" -a '(__ecaxis_devices)'
