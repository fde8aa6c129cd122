
# Network interfaces, and the devices of the machine files on the line.
_ecaxis_interfaces() {
    ls /sys/class/net
}

_ecaxis_names() {
    local word
    case "${COMP_WORDS[1]}" in
        scan|doctor)
            _ecaxis_interfaces
            ;;
        sdo|eeprom|firmware)
            for word in "${COMP_WORDS[@]}"; do
                [[ "${word}" == *.toml && -r "${word}" ]] \
                    && sed -n 's/^ *name *= *"\([^"]*\)".*/\1/p' "${word}"
            done
            ;;
    esac
}

_ecaxis_named() {
    local cur="${COMP_WORDS[COMP_CWORD]}" names IFS=$' \t\n'
    _ecaxis "$1" "$2" "$3"
    [[ "${cur}" == -* || "$3" == -* ]] && return 0
    names="$(_ecaxis_names)"
    [[ -n "${names}" ]] || return 0
    # A name may contain spaces.
    IFS=$'\n'
    COMPREPLY=( $(compgen -W "${names}" -- "${cur}") )
    [[ "${#COMPREPLY[@]}" = 0 ]] || COMPREPLY=( $(printf '%q\n' "${COMPREPLY[@]}") )
}

complete -F _ecaxis_named -o bashdefault -o default ecaxis
