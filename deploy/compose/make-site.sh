#!/bin/sh
# Creates the site of the demonstration once: an authority, a certificate for each member, a roster, and the accounts of
# the development chain, each with its own password. Each member has a folder with what it needs and sees nothing else.
# The same commands create your own site; see docs/guides/sites.md.
#
#   /site/authority  the site's certificate and key; not shared with anyone
#   /site/MEMBER     ca.pem, identity.pem, identity.key; roster.toml of routers; account.json and password of who signs;
#                    browser.token of the page
#   /chain           the development chain's keyfiles, which it writes when it has its contracts
#
# ROUTERS are the names of the routers, which are also their host names.
set -eu
umask 077

site=/site
made=$site/authority/made
routers=${ROUTERS:-router}
keys=/chain/development
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT

if [ -e "$made" ]; then
    echo "the site is there: $(cat "$made")"
    exit 0
fi

# A unique address for a member without an account.
some_address() {
    echo "0x$(od -An -tx1 -N20 /dev/urandom | tr -d ' \n')"
}

# member NAME ROLE OPTION... : a certificate, and an entry in the roster
member() {
    name=$1 role=$2
    shift 2
    aira identity new "$work/$name" --site "$work/authority" --name "$name" --role "$role" \
        --roster "$work/roster.toml" "$@" > /dev/null
    echo "  $role $name"
}

# account NAME KEYFILE : the account of the development chain, under a new password
account() {
    aira account import "$work/$1/account.json" --password-file "$work/$1/password" \
        --from-keyfile "$keys/$2.json" --from-password-file "$keys/password" > /dev/null
}

# Each file is created atomically, so that a waiting service never reads half of it.
hand_over() {
    for file in "$work/$1"/*; do
        cp "$file" "$site/$1/.new"
        mv "$site/$1/.new" "$site/$1/$(basename "$file")"
    done
}

echo "making a site:"
aira identity site "$work/authority" --name "AIRA demonstration" > /dev/null
for router in $routers; do
    member "$router" router --host "$router" --host localhost --host 127.0.0.1
done
member operator operator --address "$(some_address)"
member bridge bridge --address "$(some_address)"
aira account new "$work/validator/account.json" --password-file "$work/validator/password" > /dev/null
member validator validator --keyfile "$work/validator/account.json"
member page person --role operator --host page --host localhost --host 127.0.0.1 --address "$(some_address)"
od -An -tx1 -N16 /dev/urandom | tr -d ' \n' > "$work/page/browser.token"

until [ -s "$keys/person.json" ]; do
    [ -n "${said:-}" ] || echo "  waiting for the chain, which has the accounts"
    said=yes
    sleep 0.2
done

account provider provider & provider_account=$!
account agent robot & agent_account=$!
account person person & person_account=$!
member provider provider --keyfile "$keys/provider.json"
member agent agent --keyfile "$keys/robot.json"
member person person --keyfile "$keys/person.json"
member edge edge --address "$(some_address)" --device board --agent "$(aira account show "$keys/robot.json")"
for each in $provider_account $agent_account $person_account; do
    wait "$each"
done

for router in $routers; do
    cp "$work/roster.toml" "$work/$router/"
done
for one in authority $routers provider agent person edge bridge validator page operator; do
    hand_over "$one"
done
date -u +"made %Y-%m-%d %H:%M:%S UTC, certificates for 90 days" > "$made"
echo "the site is made; nobody has another's key"
