#!/usr/bin/env bash
# A fresh machine, for real: a bare Debian 12 with Python 3.11, make and git and nothing else, a clone of what is committed
# here, and the commands of the README, first as a user who may install nothing, then as root.
#
# Run by hand, as root, with debootstrap:   tests/fresh/bare_root.sh [--test]
# --test runs `make test` there too. DEBIAN_MIRROR names another archive than debootstrap's own; proxies (http_proxy, ...),
# PIP_* variables, pip's configuration and certificates of this machine are handed on.
set -euo pipefail
cd "$(dirname "$0")/../.."

if [ "${1:-}" != inside ]; then
  [ "$(id -u)" = 0 ] && command -v debootstrap >/dev/null || { echo "needs root and debootstrap" >&2; exit 3; }
  root=$(mktemp -d /var/tmp/bare-root.XXXXXX)
  trap 'rm -rf --one-file-system "$root" "$root.log"' EXIT
  chmod 755 "$root"
  echo "== a bare root (debootstrap, minbase)"
  debootstrap --variant=minbase bookworm "$root" ${DEBIAN_MIRROR:+"$DEBIAN_MIRROR"} >"$root.log" 2>&1 ||
    { tail -5 "$root.log"; exit 3; }
  git bundle create --quiet "$root/tmp/cosim.bundle" HEAD
  # Mounts and processes live in namespaces of their own, and end with them whatever happens.
  unshare --mount --pid --fork "$PWD/tests/fresh/bare_root.sh" inside "$root" "${1:-}"
  exit
fi

root=$2
for path in /etc/resolv.conf /etc/hosts /etc/pip.conf /usr/local/share/ca-certificates /etc/apt/apt.conf.d/*proxy*; do
  [ -e "$path" ] && mkdir -p "$root$(dirname "$path")" && cp -rT "$path" "$root$path"
done
mount -t proc proc "$root/proc"
mount --rbind /dev "$root/dev"
mapfile -t handed < <(env | grep -E '^(PIP_|https?_proxy=|HTTPS?_PROXY=|no_proxy=|NO_PROXY=)' || true)
as() { # as USER COMMAND: in a clean environment, at home
  local home=/root
  [ "$1" = root ] || home=/home/$1
  chroot "$root" setpriv --reuid "$1" --regid "$1" --init-groups env -i "${handed[@]}" HOME="$home" LANG=C.UTF-8 \
    PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin bash -c "cd ~ && $2"
}
fail() { echo "FAILED: $*"; exit 1; }
try() { # try USER COMMAND: show it, keep what it says in $said, its exit code in $code, its seconds in $took
  local started=$SECONDS log
  log=$(mktemp)
  echo; echo "== $1: $2"
  set +e; as "$1" "$2" 2>&1 | tee "$log"; code=${PIPESTATUS[0]}; set -e
  said=$(cat "$log"); took=$((SECONDS - started)); rm -f "$log"
  echo "== exit code $code, $took s"
}

echo "== python3.11, python3.11-venv, make, git"
as root "apt-get -qq update && apt-get -qq install -y --no-install-recommends python3.11 python3.11-venv make git" \
  >"$root/tmp/apt.log" 2>&1 || { tail -5 "$root/tmp/apt.log"; fail "the bare root is not whole"; }
chroot "$root" useradd --create-home walker
for who in walker root; do as "$who" "git -c advice.detachedHead=false clone --quiet /tmp/cosim.bundle cosim"; done

for verb in run test; do
  try walker "cd cosim && make $verb"
  [ "$code" != 0 ] || fail "a user without the libraries was not stopped"
  for package in libx11-6 libxext6 libxrender1 libgl1 libatomic1; do
    grep -q "$package" <<<"$said" || fail "$package was not named"
  done
  [ "$(grep -c '^error: ' <<<"$said")" = 1 ] || fail "it was not told once"
  [ -z "$(as walker 'cd cosim && git status --short --ignored')" ] || fail "something was begun all the same"
done

try root "cd cosim && make run"
[ "$code" = 0 ] && grep -q "Run folder: " <<<"$said" || fail "make run did not end well"
try root "cd cosim && .venv/bin/cosim doctor"
[ "$code" = 0 ] || fail "the doctor finds something"
try root "cd cosim && make run"
grep -q "Set-up" <<<"$said" && fail "the second make run set up again"
try walker "cd cosim && make .venv/run.stamp && .venv/bin/cosim list"
[ "$code" = 0 ] || fail "a user cannot set up when all is there"
if [ "$3" = --test ]; then
  try root "cd cosim && make test"
  [ "$code" = 0 ] || fail "make test did not end well"
fi
echo; echo "== all as it should be"
