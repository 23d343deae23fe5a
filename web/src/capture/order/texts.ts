/** Texts of the order of an acquisition. */
import { texts } from "../../i18n";

const en = {
  title: "Order and patient",
  hint: "Who may only look at results does not see this.",
  none: "No order is chosen yet.",
  chosen: "Chosen: {patient}, accession number {accession}",
  nobody: "no name",
  accession: "Accession number",
  patientId: "Patient id",
  patientName: "Family name and given name, as Family^Given",
  birth: "Date of birth",
  find: "Look the order up",
  found: "One order was found.|{n} orders were found.",
  nothing: "No order was found. It can be entered by hand.",
  more: "There are more: give more to look for.",
  choose: "Choose",
  byHand: "Use what is entered",
  remove: "Remove the order",
};

const it: { [K in keyof typeof en]: string } = {
  title: "Richiesta e paziente",
  hint: "Chi può solo guardare i risultati non vede questi dati.",
  none: "Nessuna richiesta scelta.",
  chosen: "Scelta: {patient}, numero di accesso {accession}",
  nobody: "senza nome",
  accession: "Numero di accesso",
  patientId: "Identificativo del paziente",
  patientName: "Cognome e nome, nella forma Cognome^Nome",
  birth: "Data di nascita",
  find: "Cerca la richiesta",
  found: "Trovata una richiesta.|Trovate {n} richieste.",
  nothing: "Nessuna richiesta trovata. Si può inserire a mano.",
  more: "Ce ne sono altre: indica più dati da cercare.",
  choose: "Scegli",
  byHand: "Usa i dati inseriti",
  remove: "Togli la richiesta",
};

export const t = texts({ en, it });
