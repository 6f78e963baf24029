#!/bin/bash
# Instruments with lines of text, made of a shell: $1 what it is, $2 a file with what it measures (mm, or mm of three axes, or degrees C).
case "$1" in
gauge)      # answers "?" with its plunger, which goes in when the target comes nearer
    while IFS= read -r -d $'\r' question; do
        case "$question" in
        '?') read -r value <"$2"; if [ "$value" = lifted ]; then printf 'ERR 21\r'; else printf '%+09.4f\r' "$value"; fi ;;
        'ID?') printf 'SN 7041\r' ;;
        esac
    done ;;
readout)    # prints three axes when it gets a Ctrl-B
    while IFS= read -r -n 1 -d '' question; do
        if [ "$question" = $'\x02' ]; then read -r x y z <"$2"; printf 'X = %.3f; Y = %.3f; Z = %.3f\r\n' "$x" "$y" "$z"; fi
    done ;;
sensor)     # sends distance and state by itself, and notes beside the file what it has sent
    while :; do read -r value state <"$2"; printf '%.4f,%d\r\n' "$value" "$state" || exit; echo "$value $state" >"$2.sent"; sleep 0.02; done ;;
logger)
    while :; do read -r value <"$2"; printf 'T1=%s C\r\n' "$value" || exit; sleep 0.1; done ;;
esac
