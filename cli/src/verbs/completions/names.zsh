
# The devices of the machine files on the line, and files.
_ecaxis_devices() {
    local -a names
    local word
    for word in ${(Q)${(z)BUFFER}}; do
        [[ $word == *.toml && -r $word ]] \
            && names+=(${(f)"$(sed -n 's/^ *name *= *"\([^"]*\)".*/\1/p' $word)"})
    done
    compadd -a names
    _default
}
